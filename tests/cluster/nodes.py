"""A Ray cluster of several machines on this one: real raylets by `ray start`, each with its own address (127.0.0.x),
its own resources and its own processes, with token authentication on. Nothing outside it is touched.
"""

import contextlib
import importlib.util
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import namedtuple
from pathlib import Path

from tests.cluster.servers import free_port, wait_until

ROOT = Path(__file__).resolve().parents[2]
RAY = [sys.executable, "-m", "ray.scripts.scripts"]
TRIES = 3
PATIENCE = 400  # seconds for a node to start: ten when the machine is idle
OBJECT_STORE = 100 * 1024**2  # bytes per node; Ray's least is 75 MiB


def has_dashboard():
    """Whether Ray's dashboard is installed (the extra `cluster`)."""
    return importlib.util.find_spec("aiohttp_cors") is not None


class Nodes:
    """The head is node 0; a context manager that ends all processes of the cluster, and only those.

    head_cpus, cpus: declared CPUs of the head and of the nodes after it (they need not exist). environment: for the
    nodes' processes, over this one's. dashboard: whether there is one, which `submit` needs.

    address: of the cluster (host:port). dashboard: its URL, if it has one. environment: what a driver's process needs
    to join. log: of all nodes' `ray start`, text.
    """

    def __init__(self, cpus=(), head_cpus=1, dashboard=False, environment=None):
        # sockets lie in the folder, and their paths must be short
        self.folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))
        self._known = {}  # start time by id of the processes that were seen
        token = os.environ.get("RAY_AUTH_TOKEN") or secrets.token_hex(32)
        own = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token}
        own |= {
            "RAY_USAGE_STATS_ENABLED": "0",
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        self._environment = {**os.environ, **own, **(environment or {})}
        for name in ("RAY_ADDRESS", "RAY_JOB_ID"):
            self._environment.pop(name, None)
        self._dashboard = dashboard
        self._cpus, self._head_cpus, self._nodes = tuple(cpus), head_cpus, []

    def __enter__(self):
        try:
            port, page = free_port(), free_port()
            self.dashboard = f"http://127.0.0.1:{page}" if self._dashboard else None
            self.address = f"127.0.0.2:{port}"
            self.environment = {**self._environment, "RAY_ADDRESS": self.address}
            head = ["--head", f"--port={port}"]
            head += [f"--ray-client-server-port={free_port()}"] if has_dashboard() else []  # comes with it
            head += [f"--include-dashboard={str(self._dashboard).lower()}", f"--dashboard-port={page}"]
            self._start(head, self._head_cpus)
            for cpus in self._cpus:
                self._start([f"--address={self.address}"], cpus)
        except BaseException as error:
            error.add_note(self.log[-3000:])
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        self.processes()
        for process in reversed(self._nodes):
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + 20
        while self.processes() and time.monotonic() < deadline:
            for process in self._nodes:
                process.poll()
            time.sleep(0.2)
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for process in self._nodes:
            process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def add(self, num_cpus):
        """Start another node; returns its index."""
        self._start([f"--address={self.address}"], num_cpus)
        return len(self._nodes) - 1

    def kill(self, index):
        """SIGKILL the raylet of a node, as if its machine were gone: its workers end with it."""
        (raylet,) = self._raylets(index)
        os.kill(raylet, signal.SIGKILL)

    def ip(self, index):
        """The address of a node."""
        return f"127.0.0.{index + 2}"

    def alive(self):
        """Indices of the nodes whose raylet lives. (When the cluster notices that one does not is up to Ray.)"""
        return [index for index in range(len(self._nodes)) if self._raylets(index)]

    def _raylets(self, index):
        stats = {pid: _stat(pid) for pid in self.processes()}
        return [
            pid
            for pid, stat in stats.items()
            if stat and (stat.name, stat.parent) == ("raylet", self._nodes[index].pid)
        ]

    def processes(self):
        """Ids of the cluster's living processes: all that descend from its `ray start`s, as far as it was looked."""
        all_now = {pid: stat for pid in _pids() if (stat := _stat(pid))}
        for process in self._nodes:
            if process.pid in all_now:
                self._known[process.pid] = all_now[process.pid].start
        living = {pid for pid, start in self._known.items() if pid in all_now and all_now[pid].start == start}
        while new := {pid for pid, stat in all_now.items() if stat.parent in living} - living:
            living |= new
        self._known = {pid: all_now[pid].start for pid in living}
        return sorted(pid for pid in living if all_now[pid].state != "Z")

    def submit(self, *command, working_dir=None, patience=600):
        """`ray job submit` of a command; (exit status, output)."""
        line = [*RAY, "job", "submit", "--address", self.dashboard]
        line += ["--working-dir", str(working_dir)] if working_dir else []
        result = subprocess.run(
            [*line, "--", *command],
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=patience,
        )
        return result.returncode, result.stdout

    def actors(self):
        """[(class, address of its node, "nowhere" before it has one)] of all actors so far, by the dashboard."""
        addresses = {node["node_id"]: node["node_ip"] for node in self._state("nodes")}
        actors = self._state("actors")
        return sorted((actor["class_name"], addresses.get(actor["node_id"]) or "nowhere") for actor in actors)

    def _state(self, what):
        request = urllib.request.Request(
            f"{self.dashboard}/api/v0/{what}?limit=1000&detail=1",
            headers={"Authorization": f"Bearer {self.environment['RAY_AUTH_TOKEN']}"},
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["data"]["result"]["result"]

    @property
    def log(self):
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("node*.log")))

    def _start(self, arguments, cpus):
        """Start the next node and wait until the cluster has it.

        A raylet gives its agent 15 s to start, which nothing can change, and ends otherwise; on a busy machine that is
        too short now and then, so that a node is tried a few times.
        """
        index = len(self._nodes)
        for attempt in range(TRIES):
            process, log = self._run(index, attempt, arguments, cpus)
            self._nodes[index:] = [process]
            wait_until(
                lambda path=log, node=process: node.poll() is not None or "Ray runtime started" in path.read_text(),
                PATIENCE,
                f"node {index}",
            )
            if process.poll() is None:
                return
        raise AssertionError(f"node {index} did not start in {TRIES} tries")

    def _run(self, index, attempt, arguments, cpus):
        ports = [f"--{name}-port={free_port()}" for name in ("dashboard-agent-listen", "dashboard-agent-grpc")]
        ports += [f"--{name}-port={free_port()}" for name in ("metrics-export", "runtime-env-agent")]
        ports += ["--min-worker-port=0", "--max-worker-port=0"]
        # folders of their own: of a shared one, each node's agent deletes what it holds for unused, a job's files too
        ports += [f"--temp-dir={self.folder}/{index}"]
        common = [f"--node-ip-address={self.ip(index)}", f"--num-cpus={cpus}", "--num-gpus=0", "--block"]
        log = self.folder / f"node{index}-{attempt}.log"
        with open(log, "w") as file:
            process = subprocess.Popen(
                [*RAY, "start", *arguments, *common, *ports, f"--object-store-memory={OBJECT_STORE}"],
                env=self._environment,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return process, log


Stat = namedtuple("Stat", "name parent state start")


def _pids():
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def _stat(pid):
    """`Stat` of a process, None if there is none. start: tells two processes with the same id apart."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    rest = text[text.rindex(")") + 2 :].split()
    return Stat(text[text.index("(") + 1 : text.rindex(")")], int(rest[1]), rest[0], int(rest[19]))
