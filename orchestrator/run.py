"""One training run: wires the runtime's parts, writes metrics and checkpoints, continues where it stopped.

The loop only passes handles on. Chunk k is collected with policy and thresholds k - d, d = `pipeline_depth`, whatever
the timing: with d = 1 the workers collect chunk k + 1 while the learner updates on chunk k.
"""

import json
import os
import time
from collections import deque
from dataclasses import asdict
from pathlib import Path

from learner import checkpoint
from orchestrator.curriculum import CurriculumState, final_tightenings
from orchestrator.metrics import describe_thresholds
from orchestrator.runtime import build_runtime
from workers.types import Policy, Thresholds, WorkerState


def train(config, folder, report=lambda metrics: None):
    """Run or continue the run of a `Config` in a folder; returns a summary of where it stands at the end.

    Appends one line per iteration to metrics.jsonl (what depends on the clock under keys that begin with perf/) and
    calls `report` with the same dict; checkpoints every `checkpoint.every` iterations and at the end.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    saved, _ = load_latest(folder)
    runtime = build_runtime(config, *(saved or {}).get("parts", (None, None)))
    try:
        return _Loop(config, folder, runtime, report, saved).run()
    finally:
        runtime.close()


def load_latest(folder):
    """(content of the newest checkpoint in a run's folder, its path), or (None, None) if there is none yet.

    content: iteration, parts (learner's and curriculum's state), workers, policies, thresholds.
    """
    found = checkpoint.paths(Path(folder) / "checkpoints")
    if not found:
        return None, None
    content = checkpoint.load(found[-1])
    window = tuple(tuple(entry) for entry in content["curriculum"].pop("window"))
    return {
        "iteration": content["iteration"],
        "parts": (content["learner"], CurriculumState(window=window, **content["curriculum"])),
        "workers": [WorkerState(**_arrays(item)) for item in content["workers"]],
        "policies": [Policy(**_arrays(item)) for item in content["policies"]],
        "thresholds": [Thresholds(**item) for item in content["thresholds"]],
    }, found[-1]


class _Loop:
    def __init__(self, config, folder, runtime, report, saved):
        self._config, self._folder, self._runtime, self._report = config, folder, runtime, report
        if saved is None:
            self._iteration = 0
            self._states, policy, thresholds = runtime.initial()
            self._policies, self._thresholds = [policy], [thresholds]
        else:
            self._iteration = saved["iteration"]
            self._states, self._policies, self._thresholds = (
                [runtime.handle(value) for value in saved[name]] for name in ("workers", "policies", "thresholds")
            )
        self._summary = self._summarize(saved["parts"][1] if saved else CurriculumState())
        self._metrics = _open_metrics(folder / "metrics.jsonl", self._iteration)
        self._seconds, self._last = 0.0, time.monotonic()

    def run(self):
        config, runtime = self._config, self._runtime
        depth, total = config.pipeline_depth, config.total_iterations
        pending = deque()
        with self._metrics:
            for k in range(self._iteration, total):
                chunks, outcomes, self._states = runtime.collect(self._states, self._policies[0], self._thresholds[0])
                used = self._thresholds[0]
                policy, losses = runtime.update(chunks)
                thresholds, summary = runtime.observe(outcomes)
                self._policies = [*self._policies, policy][-(depth + 1) :]
                self._thresholds = [*self._thresholds, thresholds][-(depth + 1) :]
                due = (k + 1) % config.checkpoint.every == 0 or k + 1 == total
                pending.append((k + 1, losses, summary, used, self._snapshot() if due else None))
                # at most `depth` iterations ahead of the slowest part
                while len(pending) > depth:
                    self._finish(*pending.popleft())
            while pending:
                self._finish(*pending.popleft())
        return self._summary

    def _snapshot(self):
        """Handles of all that a checkpoint holds, taken between two updates without waiting for either."""
        return self._runtime.saved(), list(self._states), list(self._policies), list(self._thresholds)

    def _finish(self, iteration, losses, summary, thresholds, snapshot):
        """Wait for an iteration; write its line of metrics, then its checkpoint."""
        losses, summary, thresholds = self._runtime.value([losses, summary, thresholds])
        now = time.monotonic()
        seconds, self._last = now - self._last, now
        self._seconds += seconds
        samples = self._config.samples_per_iteration
        metrics = {
            "iteration": iteration,
            "samples": iteration * samples,
            **summary,
            **describe_thresholds(thresholds),
            **losses,
            "perf/samples_per_second": samples / max(seconds, 1e-9),
            "perf/seconds": self._seconds,
            "perf/time": time.time(),
        }
        self._metrics.write(json.dumps(metrics) + "\n")
        self._metrics.flush()
        if snapshot is not None:
            self._save(iteration, snapshot)
        self._report(metrics)

    def _save(self, iteration, snapshot):
        value = self._runtime.value
        parts, states, policies, thresholds = snapshot
        learner, curriculum = value(parts[0]), value(parts[1])
        content = {
            "iteration": iteration,
            "learner": learner,
            "curriculum": asdict(curriculum),
            "workers": [vars(state) for state in value(states)],
            "policies": [vars(policy) for policy in value(policies)],
            "thresholds": [vars(item) for item in value(thresholds)],
        }
        checkpoint.save(self._folder / "checkpoints", iteration, content, self._config.checkpoint.keep)
        self._summary = self._summarize(curriculum)

    def _summarize(self, curriculum):
        return {
            "iterations": curriculum.iteration,
            "samples": curriculum.iteration * self._config.samples_per_iteration,
            "tightenings": curriculum.tightenings,
            "final_tightenings": final_tightenings(self._config.curriculum),
            "irfa": curriculum.achieved_at,
        }


def _arrays(item):
    """Tensors of a checkpoint as numpy arrays, lists of them as tuples."""
    out = {}
    for name, value in item.items():
        if isinstance(value, list):
            value = tuple(part.numpy() for part in value)
        elif hasattr(value, "numpy"):
            value = value.numpy()
        out[name] = value
    return out


def _open_metrics(path, iteration):
    """The metrics file, open for appending, without lines of iterations after `iteration`, which will be repeated."""
    kept = []
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                number = json.loads(line)["iteration"]
            except (ValueError, KeyError):
                break  # the end of a line that a crash cut off
            if number <= iteration:
                kept.append(line + "\n")
    temporary = path.with_suffix(".tmp")
    with open(temporary, "w") as file:
        file.writelines(kept)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    return open(path, "a")
