"""One training run: wires the runtime's parts, writes metrics and checkpoints, continues where it stopped.

The loop only passes handles on. Chunk k is collected with policy and thresholds k - d, d = `pipeline_depth`, whatever
the timing: with d = 1 the workers collect chunk k + 1 while the learner updates on chunk k.
"""

import time
from collections import deque
from pathlib import Path

from learner import checkpoint
from motion.state_machine import build_state_machine
from orchestrator import faults, start
from orchestrator.curriculum import CurriculumState, final_tightenings
from orchestrator.history import History
from orchestrator.metrics import describe_thresholds
from orchestrator.runtime import FAULTS, build_runtime, describe, is_fault
from orchestrator.saved import check_same_run, content_of, load_latest, place


class Stopped(KeyboardInterrupt):
    """The run was asked to stop and has written a checkpoint of the iteration that it reached."""


def train(config, folder, report=lambda metrics: None, stop=lambda: False, notice=lambda line: None):
    """Run or continue the run of a `Config` in a folder; returns a summary of where it stands at the end.

    Appends one line per iteration to metrics.jsonl (what depends on the clock under keys that begin with perf/) and
    calls `report` with the same dict; checkpoints every `checkpoint.every` iterations and at the end. When `stop()`
    becomes true it writes a checkpoint and raises `Stopped`.

    Lost processes and machines: a rollout worker is replaced by its runtime; if another part is lost, the run goes
    back to its last checkpoint and repeats the iterations since, which gives the same numbers. `notice` is called with
    a line of text each time. After `faults.restarts` such faults without a new iteration in between, the fault is
    raised.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    clips = build_state_machine(config.motions).clips_hash
    fault, reached, in_a_row = None, None, 0
    while True:
        saved, path = load_latest(folder, config)
        if saved is None and config.start.checkpoint is not None:
            content, source = start.content(config, clips)
            checkpoint.save(place(folder, config), 0, content, config.checkpoint.keep)
            notice(f"begins with the learner of {source}")
            saved, path = load_latest(folder, config)
        if fault:
            where = f"goes on from the checkpoint of iteration {saved['iteration']}" if saved else "starts again"
            notice(f"{describe(fault)}; {where}")
        if saved is not None:
            check_same_run(saved, config, clips, path)
        runtime, loop = None, None
        try:
            runtime = build_runtime(config, *(saved or {}).get("parts", (None, None)), notice=notice)
            loop = _Loop(config, clips, folder, runtime, report, stop, saved)
            return loop.run()
        except FAULTS as error:
            if not is_fault(error):
                raise
            last = loop.last if loop else 0
            in_a_row = in_a_row + 1 if last == reached else 1
            reached = last
            if in_a_row > config.faults.restarts:
                raise
            fault = error
        finally:
            if runtime:
                runtime.close()


class _Loop:
    def __init__(self, config, clips, folder, runtime, report, stop, saved):
        self._config, self._clips, self._folder, self._runtime = config, clips, folder, runtime
        self._report, self._stop = report, stop
        self._iteration = saved["iteration"] if saved else 0
        if not self._iteration:
            self._states, policy, thresholds = runtime.initial()
            self._policies, self._thresholds = [policy], [thresholds]
        else:
            self._states, self._policies, self._thresholds = (
                [runtime.handle(value) for value in saved[name]] for name in ("workers", "policies", "thresholds")
            )
        self._summary = self._summarize(saved["parts"][1] if saved else CurriculumState())
        self._history = History(folder / "metrics.jsonl", self._iteration)
        self._seconds, self._last = self._history.seconds, time.monotonic()

    @property
    def last(self):
        """The newest iteration that the run has ever finished."""
        return self._history.last

    def run(self):
        config, runtime = self._config, self._runtime
        depth, total = config.pipeline_depth, config.total_iterations
        pending, stopping = deque(), False
        with self._history:
            for k in range(self._iteration, total):
                begun = self._states, self._policies[0], self._thresholds[0]
                chunks, outcomes, self._states = runtime.collect(*begun)
                policy, losses = runtime.update(chunks)
                thresholds, summary = runtime.observe(outcomes)
                self._policies = [*self._policies, policy][-(depth + 1) :]
                self._thresholds = [*self._thresholds, thresholds][-(depth + 1) :]
                stopping = self._stop()
                due = stopping or (k + 1) % config.checkpoint.every == 0 or k + 1 == total
                pending.append((k + 1, losses, summary, (*begun, outcomes), self._snapshot() if due else None))
                # at most `depth` iterations ahead of the slowest part
                while len(pending) > depth:
                    self._finish(*pending.popleft())
                if stopping:
                    break
            while pending:
                self._finish(*pending.popleft())
        if stopping:
            raise Stopped
        return self._summary

    def _snapshot(self):
        """Handles of all that a checkpoint holds, taken between two updates without waiting for either."""
        return self._runtime.saved(), list(self._states), list(self._policies), list(self._thresholds)

    def _finish(self, iteration, losses, summary, evidence, snapshot):
        """Wait for an iteration; write its line of metrics, then its checkpoint.

        evidence: handles of what its chunks were collected from (states, policy, thresholds), and of the outcomes.
        """
        losses, summary, thresholds = self._runtime.value([losses, summary, evidence[2]])
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
        self._history.write(metrics)
        faults.check(self._config, self._folder, metrics, lambda: [self._runtime.value(item) for item in evidence])
        if snapshot is not None:
            self._save(iteration, snapshot)
        self._report(metrics)

    def _save(self, iteration, snapshot):
        value = self._runtime.value
        parts, states, policies, thresholds = snapshot
        learner, curriculum = value(parts[0]), value(parts[1])
        content = content_of(
            self._config, self._clips, iteration, learner, curriculum, value(states), value(policies), value(thresholds)
        )
        self._history.sync()  # a checkpoint on the disk has its lines there, too
        checkpoint.save(place(self._folder, self._config), iteration, content, self._config.checkpoint.keep)
        self._summary = self._summarize(curriculum)

    def _summarize(self, curriculum):
        return {
            "iterations": curriculum.iteration,
            "samples": curriculum.iteration * self._config.samples_per_iteration,
            "tightenings": curriculum.tightenings,
            "final_tightenings": final_tightenings(self._config.curriculum),
            "irfa": curriculum.achieved_at,
        }
