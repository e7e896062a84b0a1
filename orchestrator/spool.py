"""What a run's folder keeps for MLflow, so that another process can ship it later: as what, how it ended, what is on
its way. The metrics themselves are metrics.jsonl. All of it lies in .tracking/ and holds no secret.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from orchestrator.mlflow_store import RunSpec, write_json
from orchestrator.redaction import without_password

FOLDER = ".tracking"


@dataclass(frozen=True)
class Final:
    """How a run ended. status: FINISHED, FAILED or KILLED. metrics: logged at the last step. files: of the run's
    folder, by their paths relative to it. model: whether its policy is to be a registered model. milliseconds: since
    1970; together with `status` it marks, as the end time in MLflow, that all of it arrived.
    """

    status: str
    milliseconds: int
    metrics: dict = field(default_factory=dict)
    files: tuple = ()
    model: bool = False


def record_spec(spec, experiment, uri):
    """Note as what and where (None: nowhere) a run is logged.

    A run that starts or goes on has not ended: what was noted of an end goes.
    """
    folder = spec.folder / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "final.json").unlink(missing_ok=True)
    content = {"experiment": experiment, "name": spec.name, "tags": spec.tags, "params": spec.params}
    content["parent"] = str(spec.parent.folder) if spec.parent else None
    write_json(folder / "run.json", {**content, "uri": uri and without_password(uri)})


def read_spec(folder):
    """(`RunSpec`, experiment's name) as noted, None if nothing was. A sweep that was moved is found above the run."""
    content = _read(folder, "run.json")
    if content is None:
        return None
    parent = None
    if content["parent"]:
        above = folder.parent if _read(folder.parent, "run.json") else Path(content["parent"])
        found = read_spec(above)
        parent = found and found[0]
    return RunSpec(folder, content["name"], content["tags"], content["params"], parent), content["experiment"]


def read_uri(folder):
    """The noted address, passwords struck out; None if there is none."""
    return (_read(folder, "run.json") or {}).get("uri")


def record_final(folder, final):
    """Note how a run ended."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    write_json(folder / FOLDER / "final.json", asdict(final))


def read_final(folder):
    """The noted `Final`, None if there is none."""
    content = _read(folder, "final.json")
    return content and Final(**{**content, "files": tuple(content["files"])})


def record_batch(folder, run_id, values):
    """Note a batch, [(key, value, milliseconds, step)], before it is sent to a run of MLflow."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    write_json(folder / FOLDER / "batch.json", {"run_id": run_id, "values": values})


def read_batch(folder, run_id):
    """The batch last noted for a run, [] if there is none."""
    content = _read(folder, "batch.json")
    return content["values"] if content and content["run_id"] == run_id else []


def system_path(folder):
    """The samples of `orchestrator.system_metrics`: lines of JSON, which are only ever appended."""
    return folder / FOLDER / "system.jsonl"


def record_system(folder, run_id, offset):
    """Note how many bytes of the samples a run of MLflow has. To send more of them again would change nothing."""
    write_json(folder / FOLDER / "system.json", {"run_id": run_id, "offset": offset})


def read_system(folder, run_id):
    """How many bytes of the samples a run of MLflow has."""
    content = _read(folder, "system.json")
    return content["offset"] if content and content["run_id"] == run_id else 0


def _read(folder, name):
    try:
        return json.loads((folder / FOLDER / name).read_text())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
