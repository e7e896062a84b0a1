"""Runs one library in a process of its own, watches what it uses, and reads what it recorded."""

import json
import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import processes
from benchmarks.peers.child import MISSING
from benchmarks.peers.record import Record, read
from benchmarks.peers.task import WARM_UP

CPU_EVERY, MEMORY_EVERY = 1.0, 4.0  # seconds; adding up memory takes the machine's time


class Missing(Exception):
    """The interpreter lacks the library. str: which module."""


@dataclass(frozen=True)
class Run:
    """A finished run. cpu: (K, 2), times and CPU seconds of all its processes; memory: (M, 2), times and MB."""

    folder: Path
    record: Record
    cpu: np.ndarray
    memory: np.ndarray
    versions: dict

    @property
    def begin(self):
        """When the warm-up was over."""
        return self.record.begins[WARM_UP]

    @property
    def end(self):
        """When the last iteration had been learned from."""
        return self.record.begins[-1]

    def rate(self):
        """Samples per second, learning included, from the warm-up's end."""
        samples = self.record.at(self.end)[0] - self.record.at(self.begin)[0]
        return samples / (self.end - self.begin)

    def cores(self):
        """CPU seconds per second in the same time."""
        used = np.interp([self.begin, self.end], *self.cpu.T)
        return float((used[1] - used[0]) / (self.end - self.begin))

    def peak_memory(self):
        """Most MB in the run's life so far as it trained, start included."""
        return float(self.memory[self.memory[:, 0] <= self.end + MEMORY_EVERY, 1].max())


def run(line, variant, folder, samples, seconds, overrides):
    """The `Run` of a `benchmarks.peers.libraries.Line` in one of its variants. Missing; RuntimeError if it fails."""
    folder = Path(folder)
    folder.mkdir(parents=True)
    command = [
        *line.command, "--folder", str(folder), "--samples", str(samples), "--seconds", str(seconds),
        "--env-runners", str(variant.env_runners), "--threads", str(variant.threads),
        *line.arguments(folder, overrides),
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name not in ("OMP_NUM_THREADS", "RAY_ADDRESS")}
    # Ray's own niceness of 15 would let its processes starve beside anything else that the machine does
    environment |= {"RAY_worker_niceness": "0", "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": os.getcwd()}
    if variant.torch_threads:
        environment["OMP_NUM_THREADS"] = str(variant.torch_threads)
    log = folder / "log.txt"
    with open(log, "wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
        try:
            cpu, memory = watch(process)
        finally:
            process.kill()
            process.wait()
    text = log.read_text(errors="replace").strip().splitlines() or ["no output"]
    if process.returncode == MISSING:
        raise Missing(text[-1])
    record = read(folder.glob("*.record"))
    done = len(record.begins) > WARM_UP and record.at(record.begins[-1])[0] >= samples
    # 130: Segue was still ending when the time ran out that it gives itself after an interrupt
    if process.returncode not in (0, 130) or not done:
        raise RuntimeError(f"{line.title} ended with status {process.returncode}; all of it: {log}\n{text[-1]}")
    return Run(folder, record, np.array(cpu), np.array(memory), json.loads((folder / "versions.json").read_text()))


def watch(process):
    """(CPU seconds, MB) over time of a process and its descendants until it ends, as lists of (time, value)."""
    cpu, memory, used = [], [], processes.CPU(process.pid)
    while process.poll() is None:
        now = time.monotonic()
        cpu.append((now, used.seconds()))
        if not memory or now - memory[-1][0] >= MEMORY_EVERY:
            memory.append((now, processes.memory(processes.tree(process.pid))))
        time.sleep(CPU_EVERY)
    return cpu, memory
