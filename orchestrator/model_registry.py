"""The policy of a finished run as a registered model of MLflow, which `mlflow.pytorch.load_model` loads without Segue.

Everything is looked for before it is made, under the policy's checksum, so that the same call again, after a lost
answer, by another process or after a second evaluation, changes nothing. mlflow's own `log_model` cannot do that; it
would also set the process's tracking address, and start two processes to find out what torch needs.
"""

import json
import tempfile
from pathlib import Path

from orchestrator import folder as run_folder
from orchestrator.saved import load_latest
from orchestrator.settings import load

MODEL = "policy"  # the model's name within its run: runs:/RUN_ID/policy
POLICY_TAG = "segue.policy"  # SHA-256 of the policy
VERSIONS_TAG = "mlflow.modelVersions"  # by which MLflow's pages of a run and of a model know the registered versions

DESCRIPTION = """\
Policies of row `{row}`: 282 numbers of a pose and its target (float32, as `workers/observation.py` gives them) to 31 \
numbers, the mean action in units of `action.scale`. One version per run; the alias `seed0` is the newest of seed 0.

```python
import mlflow.pytorch, torch
policy = mlflow.pytorch.load_model("models:/{name}@seed0")
action = policy(torch.zeros(1, 282))   # (1, 31)
```
"""


def registered_name(experiment, row):
    """Name of the registered model of a row of a sweep (or of `orchestrator.train`, whose experiment is `train`)."""
    return f"{experiment}-{row}"


def policy_of(folder):
    """The policy (`workers.types.Policy`) that a run's evaluation is about, None if its checkpoints are gone."""
    saved, _ = load_latest(folder, load(run_folder.config_path(folder)))
    return saved and saved["policies"][-1].averaged()


def ship(client, experiment, experiment_id, run_id, values, step, spec):
    """Log and register the policy of a run's folder, as far as MLflow lacks it. Returns the version's number or None.

    values: [(key, value, milliseconds, step)], the model's metrics. step: last iteration of the run. spec: its
    `mlflow_store.RunSpec`, with tags `row` and `seed`.
    """
    from mlflow.entities import Metric

    from learner.export import digest

    if not run_folder.config_path(spec.folder).exists() or (policy := policy_of(spec.folder)) is None:
        return None
    mark = digest(policy)
    name, alias = registered_name(experiment, spec.tags["row"]), f"seed{spec.tags['seed']}"
    model = _logged_model(client, experiment_id, run_id, mark, spec)
    if model.status != "READY":
        with tempfile.TemporaryDirectory() as folder:
            save(policy, Path(folder) / "model", model, run_id)
            client.log_model_artifacts(model.model_id, str(Path(folder) / "model"))
        client.finalize_logged_model(model.model_id, "READY")
    _as_output(client, run_id, model.model_id, step)
    if values and not client.get_logged_model(model.model_id).metrics:
        client.log_batch(run_id, metrics=[Metric(*value, model_id=model.model_id, run_id=run_id) for value in values])
    version = _version(client, name, run_id, mark, model, spec)
    note = json.dumps([{"name": name, "version": str(version)}])
    if client.get_logged_model(model.model_id).tags.get(VERSIONS_TAG) != note:
        client.set_logged_model_tags(model.model_id, {VERSIONS_TAG: note})
    if str(client.get_registered_model(name).aliases.get(alias)) != str(version):
        client.set_registered_model_alias(name, alias, version)
    return int(version)


def save(policy, path, model=None, run_id=None):
    """Write a policy as an MLflow model into a new folder: torch's own format pt2, which holds no pickled code.

    model: the `LoggedModel` that it will belong to.
    """
    import logging

    import mlflow.pytorch
    import numpy as np
    import torch
    from mlflow.models import Model, ModelSignature
    from mlflow.types import Schema, TensorSpec

    from learner.export import export

    logging.getLogger("mlflow").setLevel(logging.ERROR)
    inputs, outputs = policy.weights[0].shape[0], policy.biases[-1].shape[0]
    signature = ModelSignature(
        inputs=Schema([TensorSpec(np.dtype(np.float32), (-1, inputs))]),
        outputs=Schema([TensorSpec(np.dtype(np.float32), (-1, outputs))]),
    )
    target = Model(model_id=model.model_id, run_id=run_id, artifact_path=model.artifact_location) if model else None
    # two rows: with one, the number of rows would be fixed. The mean: zeros after normalising
    example = np.tile(np.asarray(policy.observation_mean, dtype=np.float32), (2, 1))
    mlflow.pytorch.save_model(
        export(policy), str(path), mlflow_model=target, signature=signature, input_example=example,
        serialization_format="pt2", pip_requirements=[f"torch=={torch.__version__.split('+')[0]}", "numpy"],
    )  # fmt: skip


def _logged_model(client, experiment_id, run_id, mark, spec):
    """The run's `LoggedModel` of the policy, ready or begun; made if there is none."""
    found = client.search_logged_models(
        [experiment_id], f"source_run_id = '{run_id}' AND tags.`{POLICY_TAG}` = '{mark}'", max_results=1
    )
    if found:
        return found[0]
    return client.create_logged_model(
        experiment_id, MODEL, run_id, tags={**_own(spec.tags), POLICY_TAG: mark}, params=spec.params
    )


def _as_output(client, run_id, model_id, step):
    """Say in the run that the model is its output, once; without it, runs:/RUN_ID/policy finds nothing."""
    from mlflow.entities import LoggedModelOutput

    outputs = client.get_run(run_id).outputs
    if model_id not in [output.model_id for output in (outputs.model_outputs if outputs else [])]:
        client.log_outputs(run_id, [LoggedModelOutput(model_id, step)])


def _version(client, name, run_id, mark, model, spec):
    """Number of the registered version of the model, made if it is not there."""
    from mlflow.exceptions import MlflowException

    found = client.search_model_versions(f"name = '{name}' AND run_id = '{run_id}'")
    same = [version for version in found if version.tags.get(POLICY_TAG) == mark]
    if same:
        return same[0].version
    try:
        client.create_registered_model(name, description=DESCRIPTION.format(name=name, row=spec.tags["row"]))
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise
    # by its place: an address of the form models:/ID would be looked up at the process's tracking address
    made = client.create_model_version(
        name, model.artifact_location, run_id, tags={**_own(spec.tags), POLICY_TAG: mark},
        model_id=model.model_id, await_creation_for=0,
    )  # fmt: skip
    return made.version


def _own(tags):
    """Tags without those that MLflow gives a meaning of its own to runs."""
    return {key: value for key, value in tags.items() if not key.startswith("mlflow.")}
