"""A run that begins with another run's learner: what it takes over, what begins anew, and that nothing else matters."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from training import Killed, killed_after, lines

from learner import checkpoint
from learner.storage import replace_file
from motion.errors import InputError
from orchestrator import saved, start
from orchestrator.run import train
from orchestrator.settings import build, command_line
from orchestrator.validate import check_values
from workers.worker import RolloutWorker

OLD = Path(__file__).parents[1] / "learner/checkpoints/schema4.pt"  # of a version without these keys
EASY = {"curriculum.start": [50.0, 500.0, 50.0], "curriculum.window": 1, "curriculum.floor": [1e-9] * 3}


@pytest.fixture(scope="module")
def configure(make_config):
    def make(**changes):
        # a learner with all of its parts, and thresholds that are cut on the way
        return make_config({"policy.average": 0.9, "policy.judges": 2, **EASY, "task.max_steps": 8, **changes})

    return make


@pytest.fixture(scope="module")
def source(configure, tmp_path_factory):
    """The folder of the run that others begin with."""
    folder = tmp_path_factory.mktemp("source")
    train(configure(), folder)
    assert content(folder)["parts"][1].tightenings > 0
    return folder


@pytest.fixture(scope="module")
def begun(configure, source, tmp_path_factory):
    """The folder of a run that began with it, other settings, and has finished."""
    folder = tmp_path_factory.mktemp("begun")
    train(other(configure, source), folder)
    return folder


def other(configure, where, **changes):
    changes = {"seed": 3, "ppo.gae_lambda": 0.5, "curriculum.achievement": 0.1, **changes}
    return configure(**{"start.checkpoint": str(where), "policy.log_sigma": -2.0, **changes})


def content(folder):
    return saved.load_latest(folder)[0]


def same(folder, reference, assert_same_bits):
    assert lines(folder) == lines(reference)
    one, two = content(folder), content(reference)
    for key in ("iteration", "parts", "policies", "thresholds", "workers"):
        assert_same_bits(one[key], two[key])


def test_the_learner_is_the_sources_and_counts_from_zero(configure, source, tmp_path, assert_same_bits):
    first = []
    with pytest.raises(KeyboardInterrupt):
        train(other(configure, source), tmp_path, first.append, stop=lambda: True)
    was, copy = content(source)["parts"][0], saved.load_file(tmp_path / "checkpoints/00000000.pt")
    for name in ("policy", "value", "average", "policy_optimizer", "value_optimizer", "observations", "returns"):
        assert_same_bits(copy["parts"][0][name], was[name])
    assert copy["parts"][0]["learning_rate"] == was["learning_rate"]
    assert copy["parts"][0]["updates"] == 0 and was["updates"] > 0
    assert (first[0]["iteration"], first[0]["samples"]) == (1, 64)
    assert first[0]["thresholds/tightenings"] == content(source)["parts"][1].tightenings


def test_the_first_chunk_is_acted_with_its_policy(configure, source, tmp_path, monkeypatch, assert_same_bits):
    acted, collect = [], RolloutWorker.collect
    monkeypatch.setattr(
        RolloutWorker, "collect", lambda self, state, policy, limits: (
            acted.append((state, policy)), collect(self, state, policy, limits)
        )[1],
    )  # fmt: skip
    train(other(configure, source, **{"budget.iterations": 1}), tmp_path)
    state, policy = acted[0]
    wanted = replace(content(source)["policies"][-1], version=0, log_sigma=-2.0)
    assert_same_bits(policy, wanted)
    assert state.clock == 0 and (state.episode == 0).all()  # simulations begin anew


@pytest.mark.parametrize("scope", ["run", "group"])
def test_thresholds_begin_where_asked(scope, configure, source, tmp_path):
    changes = {"start.tightenings": 2, "curriculum.scope": scope, "curriculum.achievement": 1.0}
    train(other(configure, source, **changes), tmp_path)
    assert {line["thresholds/tightenings"] for line in lines(tmp_path)} == {2}
    tracks = content(tmp_path)["parts"][1].tracks
    assert {cuts for _, cuts in tracks} == ({2} if scope == "group" else set())


def test_clips_may_be_others(configure, source, tmp_path):
    config = other(configure, source)
    config.motions = replace(config.motions, clips={"idle": config.motions.clips["idle"]})
    train(config, tmp_path)
    assert lines(tmp_path)[-1]["iteration"] == 4


def test_another_optimizer_begins_anew(configure, source, tmp_path):
    train(other(configure, source, **{"ppo.optimizer": "kfac", "ppo.natural_rate": 0.02}), tmp_path)
    rows = lines(tmp_path)
    assert rows[0]["policy/learning_rate"] == 0.02
    assert content(tmp_path)["parts"][0]["policy_optimizer"]["seen"] == rows[-1]["iteration"] == 4


@pytest.mark.parametrize("kill", [1, 3])
def test_the_source_is_read_once(kill, configure, source, begun, tmp_path, assert_same_bits):
    """Killed before and after its first checkpoint, while the source is gone: as if neither had happened."""

    copy = shutil.copytree(source, tmp_path / "source")
    config, folder = other(configure, copy), tmp_path / "run"
    with pytest.raises(Killed):
        train(config, folder, killed_after(kill))
    shutil.rmtree(copy)
    train(config, folder)
    same(folder, begun, assert_same_bits)


def test_a_file_is_as_good_as_its_folder(configure, source, begun, tmp_path, assert_same_bits):
    newest = checkpoint.paths(source / "checkpoints")[-1]
    train(other(configure, newest), tmp_path)
    same(tmp_path, begun, assert_same_bits)


@pytest.fixture(scope="module")
def policy_file(configure, source, tmp_path_factory):
    """One of the time before policy files had critics."""
    path = tmp_path_factory.mktemp("policy") / "policy.pt"
    alone = saved.policy_content(content(source), configure())
    del alone["critics"]
    replace_file(path, checkpoint.encode(alone))
    return path


def test_a_policy_file_begins_a_run_with_its_critics(configure, tmp_path, assert_same_bits):
    """Value network, its targets' scale and what foresees the cost to go, in what they say of any state; and their
    sizes are those that the run has to have."""
    on = {"arrival.weight": 0.1, "arrival.steps": 2, "physics.sole": 0.02, "arrival.hidden": [16]}
    folder, path = tmp_path / "source", tmp_path / "policy.pt"
    config = configure(**on)
    train(config, folder)
    replace_file(path, checkpoint.encode(saved.policy_content(content(folder), config)))
    with pytest.raises(KeyboardInterrupt):
        train(other(configure, path, **on), tmp_path / "run", stop=lambda: True)
    was = content(folder)["parts"][0]
    first = saved.load_file(tmp_path / "run/checkpoints/00000000.pt")["parts"][0]
    for name in ("value", "returns"):
        assert_same_bits(first[name], was[name])
    assert_same_bits(first["cost_to_go"]["network"], was["cost_to_go"]["network"])
    assert not first["value_optimizer"]["state"] and not first["cost_to_go"]["optimizer"]["state"]
    start.check(other(configure, path, **{**on, "arrival.weight": 0.0, "arrival.hidden": [8]}))
    for changes, words in (
        ({"arrival.hidden": [8]}, r"arrival.hidden=\[16\], asked for arrival.hidden=\[8\]"),
        ({"network.value_hidden": [12]}, r"network.value_hidden=null, asked for network.value_hidden=\[12\]"),
    ):
        with pytest.raises(InputError, match=words):
            start.check(other(configure, path, **{**on, **changes}))


def test_a_policy_alone_begins_a_run_with_everything_else_fresh(configure, policy_file, tmp_path, assert_same_bits):
    """A value network of another size included; the policy stays as it is for `ppo.policy_after` updates."""
    given = saved.load_file(policy_file)
    changes = {"network.value_hidden": [12], "ppo.policy_after": 3, "curriculum.achievement": 1.0}
    train(other(configure, policy_file, **changes, **{"checkpoint.every": 1, "checkpoint.keep": 9}), tmp_path)
    acted = [saved.load_file(path)["policies"][-1] for path in checkpoint.paths(tmp_path / "checkpoints")]
    assert len(acted) == 5  # after 0 to 4 updates
    for policy in acted[:4]:
        assert_same_bits(policy.weights, given["policies"][-1].weights)
        assert_same_bits(policy.biases, given["policies"][-1].biases)
    assert_same_bits(acted[3].average_weights, given["policies"][-1].weights)
    assert (acted[4].weights[0] != acted[3].weights[0]).any()
    np.testing.assert_allclose(acted[0].observation_mean, given["policies"][-1].observation_mean, rtol=1e-6)
    np.testing.assert_allclose(acted[0].observation_scale, given["policies"][-1].observation_scale, rtol=1e-4)
    rows = lines(tmp_path)
    assert {row["thresholds/tightenings"] for row in rows} == {given["parts"][1].tightenings}
    assert all("loss/value" in row for row in rows)
    assert ["loss/policy" in row for row in rows] == [False, False, False, True]
    values = [saved.load_file(path)["parts"][0]["value"] for path in checkpoint.paths(tmp_path / "checkpoints")]
    assert values[0]["0.weight"].shape == (12, 282)
    assert (values[1]["0.weight"] != values[0]["0.weight"]).any()


def test_the_normalizer_of_a_policy_has_seen_what_its_run_had(configure, policy_file, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(other(configure, policy_file), tmp_path, stop=lambda: True)
    first = saved.load_file(tmp_path / "checkpoints/00000000.pt")["parts"][0]
    assert first["observations"]["count"] == saved.load_file(policy_file)["iteration"] * 8 * 8


def test_long_first_steps_and_the_learner_of_another_run_exclude_each_other():
    with pytest.raises(InputError, match="ppo.first_updates=60 is for fresh networks.*set ppo.first_updates=0"):
        build([command_line(["ppo.first_updates=60", "start.checkpoint=runs/a"])])


def test_what_cannot_be_begun_with_is_refused_in_one_line(configure, source, policy_file, tmp_path):
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"")
    for where, changes, words in (
        (tmp_path / "nowhere", {}, "no checkpoint there"),
        (tmp_path, {}, "no checkpoint there"),
        (policy_file, {"network.hidden": [8]}, "network.hidden=[16], asked for network.hidden=[8]"),
        (policy_file, {"action.mode": "current"}, "action.mode=target, asked for action.mode=current"),
        (broken, {}, "not a readable checkpoint"),
        (source, {"network.hidden": [8]}, "network.hidden=[16], asked for network.hidden=[8]"),
        (source, {"action.scale": 3.0}, "action.scale=1.0, asked for action.scale=3.0"),
        (source, {"observation.target": "difference"}, "observation.target=absolute, asked for"),
        (OLD, {"network.hidden": [4], "observation.target": "difference"}, "observation.target=absolute, asked for"),
        (OLD, {"network.hidden": [4], "network.value_hidden": [3]}, "network.value_hidden=null, asked for"),
    ):
        with pytest.raises(InputError) as error:
            start.check(other(configure, where, **changes))
        assert words in str(error.value) and "\n" not in str(error.value)
    start.check(other(configure, source))
    with pytest.raises(InputError, match="set start.checkpoint, too"):
        check_values(configure(**{"start.tightenings": 2}), lambda key: "command line")


def test_its_path_does_not_depend_on_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert build([command_line(["start.checkpoint=runs/a"])]).start.checkpoint == str(tmp_path / "runs/a")


def test_a_policy_that_comes_with_segue_has_a_name_unless_something_here_has_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = build([command_line(["start.checkpoint=builtin"])]).start.checkpoint
    assert Path(found) == Path(__file__).parents[2] / "configs/policies/builtin.pt"
    (tmp_path / "builtin").mkdir()
    assert build([command_line(["start.checkpoint=builtin"])]).start.checkpoint == str(tmp_path / "builtin")


def test_a_network_for_arrivals_of_another_size_is_refused_and_left_out_where_none_is_used(configure, tmp_path):
    on = {"arrival.weight": 0.1, "arrival.steps": 2, "physics.sole": 0.02}
    train(configure(**{**on, "arrival.hidden": [16]}), tmp_path)
    changed = {**on, "arrival.hidden": [8]}
    with pytest.raises(InputError, match=r"arrival.hidden=\[16\], asked for arrival.hidden=\[8\]"):
        start.check(other(configure, tmp_path, **changed))
    start.check(other(configure, tmp_path, **{**changed, "arrival.hidden": [16]}))
    start.check(other(configure, tmp_path, **{**changed, "arrival.weight": 0.0}))
