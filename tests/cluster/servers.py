"""Servers that tests start as processes of their own, and a proxy that makes one fail on demand."""

import contextlib
import http.client
import http.server
import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path


def free_port():
    """A port of 127.0.0.1 that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def end(process, number=signal.SIGTERM, patience=10):
    """End a process that was started in a session of its own, and its children; none of them is left."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def wait_until(ready, seconds, what, alive=lambda: True):
    """Wait until `ready()` is true; AssertionError saying `what` after `seconds`, or as soon as `alive()` is false."""
    deadline = time.monotonic() + seconds
    while not ready():
        assert alive(), f"{what}: the process ended"
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.1)


class MlflowServer:
    """`mlflow server` in a folder of its own; a context manager. `.uri` is its address.

    store: backend store, default a SQLite file in the folder. environment: over this process's.
    """

    def __init__(self, folder, store=None, environment=None):
        self.folder, self.port = Path(folder), free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.artifacts = self.folder / "artifacts"
        self._command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(self.port)]
        self._command += ["--backend-store-uri", store or f"sqlite:///{self.folder / 'server.db'}", "--workers", "1"]
        self._command += ["--artifacts-destination", str(self.artifacts)]
        # no job runner: eight more processes, for evaluations that nobody asks for here
        quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        self._environment = {**os.environ, **quiet, **(environment or {})}
        self._environment.pop("MLFLOW_TRACKING_URI", None)

    def __enter__(self):
        self.folder.mkdir(parents=True, exist_ok=True)
        self._log = open(self.folder / "server.log", "ab")
        self.process = subprocess.Popen(
            self._command,
            cwd=self.folder,
            env=self._environment,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            wait_until(self._answers, 120, "mlflow server", lambda: self.process.poll() is None)
        except BaseException as error:
            self.__exit__()
            error.add_note((self.folder / "server.log").read_text()[-2000:])
            raise
        return self

    def __exit__(self, *_):
        end(self.process)
        self._log.close()

    def _answers(self):
        try:
            return urllib.request.urlopen(f"{self.uri}/health", timeout=2).status == 200
        except OSError:
            return False


class Proxy:
    """Passes HTTP on to a server on this machine, and fails as told; a context manager. `.uri` is its address.

    fault: a function of the request's path that returns None (pass on), "before" (hang up without passing on),
    "after" (pass on, hang up without answering) or an Event (hang up on the client now, pass on once it is set).
    seen: [(path, headers)] of what came. late: (status, body) of held requests once they were passed on.
    """

    def __init__(self, port, fault=lambda path: None):
        self.fault, self.seen, self.late = fault, [], []
        self._target, self.port = port, free_port()
        self.uri = f"http://127.0.0.1:{self.port}"

    def __enter__(self):
        proxy = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def handle_request(self):
                proxy._handle(self)

            do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = handle_request

            def log_message(self, *_):
                """Quiet."""

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    def _handle(self, request):
        body = request.rfile.read(int(request.headers.get("Content-Length", 0)))
        self.seen.append((request.path, dict(request.headers)))
        fault = self.fault(request.path)
        request.close_connection = True
        if fault == "before":
            return
        if isinstance(fault, threading.Event):
            threading.Thread(target=self._pass_on_later, args=(request, body, fault), daemon=True).start()
            return
        status, headers, answer = self._pass_on(request, body)
        if fault == "after":
            return
        request.send_response(status)
        for name, value in headers:
            if name.lower() not in ("transfer-encoding", "connection", "content-length"):
                request.send_header(name, value)
        request.send_header("Content-Length", str(len(answer)))
        request.end_headers()
        request.wfile.write(answer)

    def _pass_on_later(self, request, body, event):
        event.wait()
        status, _, answer = self._pass_on(request, body)
        self.late.append((status, answer))

    def _pass_on(self, request, body):
        connection = http.client.HTTPConnection("127.0.0.1", self._target, timeout=30)
        headers = {k: v for k, v in request.headers.items() if k.lower() not in ("host", "connection")}
        connection.request(request.command, request.path, body, {**headers, "Host": f"127.0.0.1:{self._target}"})
        answer = connection.getresponse()
        try:
            return answer.status, answer.getheaders(), answer.read()
        finally:
            connection.close()


class Postgres:
    """A PostgreSQL server of Debian's package in a folder of its own, on 127.0.0.1; a context manager.

    Its one user, `mlflow`, has a password (scram-sha-256). environment: what a client's process needs, by libpq's
    variables, so that the password stands in no address. uri: the address without it (SQLAlchemy from 2.1 on takes
    another client for a bare postgresql://).
    """

    def __init__(self):
        self.port, self._password = free_port(), secrets.token_hex(16)
        self.uri = f"postgresql+psycopg2://127.0.0.1:{self.port}/mlflow"
        self.environment = {"PGUSER": "mlflow", "PGPASSWORD": self._password}

    @staticmethod
    def programs():
        """The folder of the server's programs, None if it is not installed."""
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
        return found[-1].parent if found else None

    def __enter__(self):
        self.folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))
        try:
            (self.folder / "password").write_text(self._password)
            data = self.folder / "data"
            if os.geteuid() == 0:  # PostgreSQL refuses to run as root; Debian's package makes this user
                user = pwd.getpwnam("postgres")
                for path in (self.folder, self.folder / "password"):
                    os.chown(path, user.pw_uid, user.pw_gid)
            own = {"--username": "mlflow", "--pwfile": str(self.folder / "password"), "--auth": "scram-sha-256"}
            self._run("initdb", f"--pgdata={data}", "--no-sync", *(f"{k}={v}" for k, v in own.items()))
            settings = {"listen_addresses": "127.0.0.1", "unix_socket_directories": str(self.folder)}
            options = [f"-c{key}={value}" for key, value in settings.items()]
            self.process = subprocess.Popen(
                [*self._as_user(), str(self.programs() / "postgres"), f"-D{data}", f"-p{self.port}", *options],
                cwd=self.folder,
                stdout=open(self.folder / "server.log", "wb"),
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            wait_until(self._makes_database, 120, "PostgreSQL", lambda: self.process.poll() is None)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        if hasattr(self, "process"):
            end(self.process, signal.SIGINT)
        shutil.rmtree(self.folder, ignore_errors=True)

    def query(self, text):
        """The rows of a query, each a line of values separated by |."""
        return self._run("psql", "--no-align", "--tuples-only", f"--command={text}", "mlflow").splitlines()

    def _makes_database(self):
        try:
            self._run("createdb", "mlflow")
        except subprocess.CalledProcessError as error:
            return "already exists" in error.stderr
        return True

    def _run(self, program, *arguments):
        """Standard output of one of the server's programs."""
        here = {"PGHOST": "127.0.0.1", "PGPORT": str(self.port), **self.environment}
        return subprocess.run(
            [*self._as_user(), str(self.programs() / program), *arguments],
            cwd=self.folder,
            env={**os.environ, **here},
            check=True,
            capture_output=True,
            text=True,
        ).stdout

    @staticmethod
    def _as_user():
        return ["setpriv", "--reuid=postgres", "--regid=postgres", "--init-groups"] if os.geteuid() == 0 else []
