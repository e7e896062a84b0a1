"""A finished run's policy in MLflow: once per policy, whatever fails in between, and what it computes."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from orchestrator import mlflow_store, model_registry
from orchestrator.folder import prepare
from orchestrator.mlflow_store import RunSpec
from orchestrator.settings import build, command_line
from orchestrator.tracking import Tracker
from workers.inference import PolicyNetwork

CHECKPOINT = sorted((Path(__file__).parents[1] / "learner/checkpoints").glob("*.pt"))[-1]  # of the newest schema


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    return f"sqlite:///{tmp_path_factory.mktemp('mlflow')}/mlflow.db"


@pytest.fixture
def spec(tmp_path):
    """A run's folder with a checkpoint."""
    folder = tmp_path / "ours-seed3"
    prepare(folder, build([command_line(["scale=smoke", "seed=3"])]))
    (folder / "checkpoints").mkdir()
    shutil.copy(CHECKPOINT, folder / "checkpoints" / "00000002.pt")
    return RunSpec(folder, "ours-seed3", {"row": "ours", "seed": "3", "mlflow.x": "y"}, {"num_envs": "8"})


def begun(uri, experiment, spec):
    """(client, experiment, its id, run's id): what `ship` begins with."""
    client = mlflow_store.make_client(uri)
    experiment_id = mlflow_store.ensure_experiment(client, uri, experiment)
    return client, experiment, experiment_id, mlflow_store.ensure_run(client, uri, experiment_id, spec)


def state(client, experiment, experiment_id, run_id):
    """(versions of the registered model, its logged models, those that the run names as its outputs, aliases)."""
    name = model_registry.registered_name(experiment, "ours")
    versions = client.search_model_versions(f"name = '{name}'")
    models = client.search_logged_models([experiment_id])
    outputs = client.get_run(run_id).outputs
    return (
        [int(version.version) for version in versions],
        [(model.model_id, str(model.status), model.tags["seed"]) for model in models],
        [output.model_id for output in outputs.model_outputs],
        {alias: int(version) for alias, version in client.get_registered_model(name).aliases.items()},
    )


class Faulty:
    """A client whose every changing call has its effect and then loses its answer, the first time that it is made."""

    CALLS = (
        "create_logged_model", "log_model_artifacts", "finalize_logged_model", "log_outputs", "log_batch",
        "create_registered_model", "create_model_version", "set_logged_model_tags", "set_registered_model_alias",
    )  # fmt: skip

    def __init__(self, client):
        self._client, self.lost = client, []

    def __getattr__(self, name):
        method = getattr(self._client, name)
        if name not in self.CALLS or name in self.lost:
            return method

        def lose(*arguments, **keywords):
            method(*arguments, **keywords)
            self.lost.append(name)
            raise ConnectionError(name)

        return lose


def test_one_version_although_every_answer_was_lost_once(uri, spec):
    client, *where = begun(uri, "faults", spec)
    faulty, values = Faulty(client), [("eval/TTAR", 0.5, 1000, 2)]
    for _ in range(len(Faulty.CALLS)):
        with pytest.raises(ConnectionError):
            model_registry.ship(faulty, *where, values, 2, spec)
    assert sorted(faulty.lost) == sorted(Faulty.CALLS)
    assert model_registry.ship(faulty, *where, values, 2, spec) == 1
    found = state(client, *where)
    ((model, status, seed),) = found[1]
    assert found == ([1], [(model, "READY", "3")], [model], {"seed3": 1}) and seed == "3"
    logged = client.get_logged_model(model)
    assert [(metric.key, metric.value) for metric in logged.metrics] == [("eval/TTAR", 0.5)]
    assert logged.params == {"num_envs": "8"} and "mlflow.x" not in logged.tags


def test_another_policy_is_another_version_and_the_same_one_is_not(uri, spec, monkeypatch):
    client, *where = begun(uri, "again", spec)
    policies = [model_registry.policy_of(spec.folder)]
    policies.append(dataclasses.replace(policies[0], biases=tuple(bias + 1 for bias in policies[0].biases)))
    for policy, version in ((0, 1), (0, 1), (1, 2), (1, 2), (0, 1)):
        monkeypatch.setattr(model_registry, "policy_of", lambda folder, policy=policy: policies[policy])
        assert model_registry.ship(client, *where, [], 2, spec) == version
    versions, models, outputs, aliases = state(client, *where)
    assert sorted(versions) == [1, 2] and len(models) == len(outputs) == 2
    assert aliases == {"seed3": 1}  # the policy of the folder as it is now


def test_a_finished_run_registers_what_its_rollouts_would_do(uri, spec):
    """Through the tracker, as a run does it; the model by its version, its alias, and the run."""
    import mlflow

    for _ in range(2):  # the second time: evaluated again
        tracker = Tracker(uri, "whole", spec)
        assert tracker.finish("FINISHED", {"eval/FRPD": 0.5}, model=True, timeout=100)
    client, *where = begun(uri, "whole", spec)
    versions, models, _, _ = state(client, *where)
    assert len(versions) == len(models) == 1
    version = client.get_model_version("whole-ours", versions[0])
    assert version.run_id == where[-1] and version.tags["row"] == "ours"
    policy = model_registry.policy_of(spec.folder)
    observation = np.random.default_rng(0).normal(size=(5, 282)).astype(np.float32)
    wanted = PolicyNetwork(policy, 5).mean(observation)
    before = mlflow.get_tracking_uri()
    try:
        mlflow.set_tracking_uri(uri)
        for address in ("models:/whole-ours/1", "models:/whole-ours@seed3", f"runs:/{where[-1]}/policy"):
            got = mlflow.pytorch.load_model(address)(torch.from_numpy(observation)).detach().numpy()
            np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4)
        info = mlflow.models.get_model_info("models:/whole-ours/1")
    finally:
        mlflow.set_tracking_uri(before)
    assert [tensor.shape for tensor in info.signature.inputs.inputs] == [(-1, 282)]
    assert [tensor.shape for tensor in info.signature.outputs.inputs] == [(-1, 31)]
    assert info.saved_input_example_info


def test_a_run_without_checkpoints_has_no_model(uri, spec):
    shutil.rmtree(spec.folder / "checkpoints")
    client, *where = begun(uri, "none", spec)
    assert model_registry.ship(client, *where, [], 2, spec) is None
    assert client.search_logged_models([where[1]]) == []
