"""MLflow's address and runs: what orchestrator.shipping needs of it, with time limits on every call.

Nothing here may be called from a thread that trains: a server that does not answer costs the time limit.
"""

import fcntl
import json
import os
import uuid
from dataclasses import dataclass
from pathlib import Path

from orchestrator.redaction import without_password

# Before mlflow is imported. A dead server must cost seconds, not the minutes of the defaults.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
# No retries inside a call, whatever the user's environment says: MLflow would send the making of a run again too, and a
# lost answer would give two runs. The tracker asks first what arrived, then sends the rest again.
os.environ["MLFLOW_HTTP_REQUEST_MAX_RETRIES"] = "0"
# at the end of a run MLflow prints its address, with the password in it
os.environ["MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT"] = "true"

# MLflow's pages of an experiment are those of model training, not of language models, only if this says so
EXPERIMENT_TAGS = {
    "mlflow.experimentKind": "custom_model_development",
    "mlflow.note.content": "A run per sweep (open it with +), below it a run per row and seed.",
}
LONGEST = 6000  # characters of a parameter's value, MLflow's limit; config.yaml has all of it
ID_TAG = "segue.id"  # finds a run again whose creation was not noted before a crash


@dataclass(frozen=True)
class RunSpec:
    """A run in MLflow. folder: keeps its ids in tracking.json. tags, params: text by name. parent: the sweep's.

    system_metrics: sample the load of the machine while it runs.
    """

    folder: Path
    name: str
    tags: dict
    params: dict
    parent: "RunSpec | None" = None
    system_metrics: bool = False


def address(config):
    """Tracking address: MLFLOW_TRACKING_URI, else `tracking.uri`, else SQLite in this folder, where `mlflow ui` looks.

    SQLite paths become absolute, since trials run in other working directories.
    """
    return absolute(os.environ.get("MLFLOW_TRACKING_URI") or config.tracking.uri or "sqlite:///mlflow.db")


def absolute(uri):
    """The address, with the whole path where it is a SQLite file's."""
    path = sqlite_path(uri)
    return f"sqlite:///{path}" if path else uri


def sqlite_path(uri):
    """Absolute path of a SQLite address's file, None for other addresses."""
    return Path(uri.removeprefix("sqlite:///")).absolute() if uri.startswith("sqlite:///") else None


def ui_hint(uri):
    """The line that opens MLflow's user interface."""
    if uri.startswith(("http://", "https://")):
        return f"open {without_password(uri)}"
    return f"mlflow ui --backend-store-uri {without_password(uri)}"


def make_client(uri):
    """MlflowClient of an address. For SQLite makes the database, with its folder, if it is not there."""
    import logging

    from mlflow import MlflowClient

    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    if path := sqlite_path(uri):
        path.parent.mkdir(parents=True, exist_ok=True)
        make_database(path)
    return MlflowClient(tracking_uri=uri)


def make_database(path):
    """MLflow's SQLite database at once or not at all, by `mlflow db upgrade`; nothing if it is there.

    MLflow itself would make it in place, in many steps of several seconds in all: a run stopped meanwhile leaves
    a file that no MLflow opens any more, and two runs that start together disturb each other.
    """
    if _is_database(path):
        return
    with open(path.with_name(f".{path.name}.lock"), "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if _is_database(path):  # another process was faster
            return
        from mlflow.db import commands

        new = path.with_name(path.name + ".new")
        for left in (new, path.with_name(new.name + "-journal")):  # by a process that was killed
            left.unlink(missing_ok=True)
        commands(["upgrade", f"sqlite:///{new}"], standalone_mode=False)
        os.replace(new, path)


def _is_database(path):
    return path.exists() and path.stat().st_size > 0


def ensure_experiment(client, uri, name):
    """Id of the experiment of that name, made if it is not there. With SQLite its artifacts lie beside the database."""
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is None:
        path = sqlite_path(uri)
        location = (path.parent / "mlartifacts" / name).as_uri() if path else None
        try:
            return client.create_experiment(name, artifact_location=location, tags=EXPERIMENT_TAGS)
        except MlflowException:  # another process was faster
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    if found.lifecycle_stage != "active":
        raise RuntimeError(f"experiment {name!r} is deleted in MLflow; restore it or give the sweep another name")
    return found.experiment_id


def ensure_run(client, uri, experiment_id, spec):
    """Id of the spec's run, made (with its parent) if it is not there.

    The folder's tracking.json remembers it. Safe against crashes and against several processes asking at once. The id
    tag stays the same at every address, so that a run is found again where it was logged once, under whatever address.
    """
    parent_id = ensure_run(client, uri, experiment_id, spec.parent) if spec.parent else None
    with open(spec.folder / ".tracking.lock", "a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        note = read_note(spec.folder)
        if note.get("uri") != without_password(uri):
            note = {"uri": without_password(uri), "id": note.get("id") or uuid.uuid4().hex}
            write_note(spec.folder, note)
        run_id = find_run(client, experiment_id, note)
        if run_id is None:
            tags = {**spec.tags, ID_TAG: note["id"], **({"mlflow.parentRunId": parent_id} if parent_id else {})}
            run_id = client.create_run(experiment_id, tags=tags, run_name=spec.name).info.run_id
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
            if run.info.lifecycle_stage == "active":
                return note["run_id"]
    # the oldest, should two processes have made it at the same moment
    order = ["attributes.start_time ASC", "attributes.run_id ASC"]
    found = client.search_runs([experiment_id], f"tags.`{ID_TAG}` = '{note['id']}'", max_results=1, order_by=order)
    return found[0].info.run_id if found else None


def read_note(folder):
    """Content of a folder's tracking.json, {} if there is none or it is broken."""
    try:
        return json.loads((Path(folder) / "tracking.json").read_text())
    except (FileNotFoundError, ValueError):
        return {}


def write_note(folder, note):
    """Write a folder's tracking.json at once or not at all."""
    write_json(Path(folder) / "tracking.json", note)


def write_json(path, content):
    """Write a file at once or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(temporary, path)


def log_params(client, run_id, params):
    """Log those parameters that the run does not have. MLflow never changes one: a new value goes into a tag."""
    from mlflow.entities import Param

    data = client.get_run(run_id).data
    params = {key: value if len(value) <= LONGEST else value[: LONGEST - 1] + "…" for key, value in params.items()}
    new = [Param(key, value) for key, value in params.items() if key not in data.params]
    for first in range(0, len(new), 100):
        client.log_batch(run_id, params=new[first : first + 100])
    for key, value in params.items():
        if key in data.params and value != data.tags.get(f"changed.{key}", data.params[key]):
            client.set_tag(run_id, f"changed.{key}", value)
