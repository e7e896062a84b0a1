"""MLflow's address and runs: what orchestrator.tracking needs of it, with time limits on every call.

Nothing here may be called from a thread that trains: a server that does not answer costs the time limit.
"""

import fcntl
import json
import os
import re
import uuid
from dataclasses import dataclass
from pathlib import Path

# Before mlflow is imported. A dead server must cost seconds, not the minutes of the defaults; users' values go before.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")

ID_TAG = "segue.id"  # finds a run again whose creation was not noted before a crash


@dataclass(frozen=True)
class RunSpec:
    """A run in MLflow. folder: keeps its ids in tracking.json. tags, params: text by name. parent: the sweep's."""

    folder: Path
    name: str
    tags: dict
    params: dict
    parent: "RunSpec | None" = None


def address(config):
    """Tracking address: MLFLOW_TRACKING_URI, else `tracking.uri`, else SQLite in this folder, where `mlflow ui` looks.

    SQLite paths become absolute, since trials run in other working directories.
    """
    uri = os.environ.get("MLFLOW_TRACKING_URI") or config.tracking.uri or "sqlite:///mlflow.db"
    path = sqlite_path(uri)
    return f"sqlite:///{path}" if path else uri


def sqlite_path(uri):
    """Absolute path of a SQLite address's file, None for other addresses."""
    return Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None


def without_password(uri):
    """The address to show and to store: a password in it becomes ***."""
    return re.sub(r"(://[^:/@]*):[^@/]*@", r"\1:***@", uri)


def ui_hint(uri):
    """The line that opens MLflow's user interface."""
    if uri.startswith(("http://", "https://")):
        return f"open {without_password(uri)}"
    return f"mlflow ui --backend-store-uri {without_password(uri)}"


def make_client(uri):
    """MlflowClient of an address. For SQLite makes the file's folder; mlflow makes the tables on first use."""
    import logging

    from mlflow import MlflowClient

    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    if path := sqlite_path(uri):
        path.parent.mkdir(parents=True, exist_ok=True)
    return MlflowClient(tracking_uri=uri)


def ensure_experiment(client, uri, name):
    """Id of the experiment of that name, made if it is not there. With SQLite its artifacts lie beside the database."""
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is None:
        path = sqlite_path(uri)
        location = (path.parent / "mlartifacts" / name).as_uri() if path else None
        try:
            return client.create_experiment(name, artifact_location=location)
        except MlflowException:  # another process was faster
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    if found.lifecycle_stage != "active":
        raise RuntimeError(f"experiment {name!r} is deleted in MLflow; restore it or give the sweep another name")
    return found.experiment_id


def ensure_run(client, uri, experiment_id, spec):
    """Id of the spec's run, made (with its parent) if it is not there; its state becomes RUNNING if it is.

    The folder's tracking.json remembers it. Safe against crashes and against several processes asking at once.
    """
    parent_id = ensure_run(client, uri, experiment_id, spec.parent) if spec.parent else None
    with open(spec.folder / ".tracking.lock", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        note = read_note(spec.folder)
        if note.get("uri") != without_password(uri):
            note = {"uri": without_password(uri), "id": uuid.uuid4().hex}
            write_note(spec.folder, note)
        run_id = find_run(client, experiment_id, note)
        if run_id is None:
            tags = {**spec.tags, ID_TAG: note["id"], **({"mlflow.parentRunId": parent_id} if parent_id else {})}
            run_id = client.create_run(experiment_id, tags=tags, run_name=spec.name).info.run_id
        else:
            client.update_run(run_id, status="RUNNING")
        write_note(spec.folder, {**note, "experiment_id": experiment_id, "run_id": run_id})
        return run_id


def find_run(client, experiment_id, note):
    """Id of the live run that a note names, None if there is none (any more)."""
    from mlflow.exceptions import MlflowException

    if "run_id" in note:
        try:
            run = client.get_run(note["run_id"])
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise
        else:
            return note["run_id"] if run.info.lifecycle_stage == "active" else None
    found = client.search_runs([experiment_id], f"tags.`{ID_TAG}` = '{note['id']}'", max_results=1)
    return found[0].info.run_id if found else None


def read_note(folder):
    """Content of a folder's tracking.json, {} if there is none or it is broken."""
    try:
        return json.loads((Path(folder) / "tracking.json").read_text())
    except (FileNotFoundError, ValueError):
        return {}


def write_note(folder, note):
    """Write a folder's tracking.json at once or not at all."""
    temporary = Path(folder) / "tracking.json.tmp"
    temporary.write_text(json.dumps(note, indent=2) + "\n")
    os.replace(temporary, Path(folder) / "tracking.json")


def log_params(client, run_id, params):
    """Log those parameters that the run does not have. MLflow never changes one: a new value goes into a tag."""
    from mlflow.entities import Param

    there = client.get_run(run_id).data.params
    params = {key: value[:6000] for key, value in params.items()}
    new = [Param(key, value) for key, value in params.items() if key not in there]
    for first in range(0, len(new), 100):
        client.log_batch(run_id, params=new[first : first + 100])
    for key, value in params.items():
        if key in there and there[key] != value:
            client.set_tag(run_id, f"changed.{key}", value)
