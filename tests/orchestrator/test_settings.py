"""Precedence of files and overrides, bad input, and the configuration's file."""

import operator

import pytest

from motion.errors import InputError
from orchestrator import settings
from orchestrator.keys import all_keys, find_key, suggestion
from orchestrator.settings import Layer, build, command_line, load, save
from orchestrator.validate import RULES


def of(*arguments):
    """Config of a command line."""
    return build([command_line(arguments)])


def error_of(*arguments):
    """The one line that a command line's mistake is answered with."""
    with pytest.raises(InputError) as caught:
        of(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_scale_file_lies_over_defaults_and_under_overrides():
    smoke = of("scale=smoke")
    assert (smoke.scale, smoke.num_envs, smoke.ppo.clip) == ("smoke", 8, 0.2)
    # the scale's file does not undo what stands before it on the command line
    assert of("num_envs=5", "scale=smoke").num_envs == 5


def test_a_scale_may_be_on_another(tmp_path, monkeypatch):
    """Its own keys win; its budget replaces the other's; `precise` is on `laptop`."""
    (tmp_path / "scale").mkdir()
    (tmp_path / "motions").symlink_to(settings.config_folder() / "motions")
    for name, text in {
        "low": "num_envs: 3\nhorizon: 4\nbudget: {samples: 100}",
        "high": "scale: low\nhorizon: 5\nbudget: {iterations: 7}",
        "round": "scale: trip",
        "trip": "scale: round",
        "lost": "scale: lo",
    }.items():
        (tmp_path / "scale" / f"{name}.yaml").write_text(text)
    laptop, precise = of("scale=laptop"), of("scale=precise")
    assert precise.action == laptop.action and precise.network.hidden != laptop.network.hidden
    monkeypatch.setattr(settings, "config_folder", lambda: tmp_path)
    found = of("scale=high")
    assert (found.scale, found.num_envs, found.horizon) == ("high", 3, 5)
    assert (found.budget.samples, found.budget.iterations) == (None, 7)
    assert "on itself" in error_of("scale=round")
    assert "lost.yaml: scale=lo is not known" in error_of("scale=lost") and "'low'" in error_of("scale=lost")


def test_layers_win_in_order_and_the_last_scale_counts():
    base = Layer({"scale": "laptop", "ppo.clip": 0.3, "sbc.enabled": True}, "base")
    row = Layer({"sbc": {"enabled": False}}, "row")
    config = build([base, row, command_line(["scale=smoke", "ppo.clip=0.4"])])
    assert (config.scale, config.num_envs, config.ppo.clip, config.sbc.enabled) == ("smoke", 8, 0.4, False)


def test_motions_choose_a_file_and_dotted_keys_lie_over_it(tmp_path):
    assert of("scale=smoke").motions.name == "builtin"
    config = of("scale=smoke", "motions.dir=clips", "motions.clips.Atk_Stab.start=0.5", "motions=three")
    assert config.motions.name == "three"
    assert config.motions.clips["Atk_Stab"].start == 0.5
    assert config.motions.dir.startswith("/")
    own = tmp_path / "own.yaml"
    own.write_text("name: own\nclips:\n  rest:\n    file: builtin:idle\n    looping: true\n")
    config = of("scale=smoke", f"motions={own}")
    assert list(config.motions.clips) == ["rest"]


def test_values_are_yaml():
    config = of(
        "scale=smoke",
        "network.hidden=[64,32]",
        "ppo.target_kl=null",
        "budget.samples=2e6",
        "motions.groups=[[idle,run]]",
    )
    assert config.network.hidden == [64, 32]
    assert config.ppo.target_kl is None
    assert config.budget.samples == 2_000_000 and isinstance(config.budget.samples, int)
    assert config.motions.groups == [["idle", "run"]]
    assert of("scale=smoke", "tracking.uri=http://host:5000").tracking.uri == "http://host:5000"


def test_a_budget_replaces_the_one_below():
    assert of("scale=smoke", "budget.samples=6400").total_iterations == 100
    both = of("scale=smoke", "budget.samples=6400", "budget.iterations=7")
    assert both.total_iterations == 7


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("sbc.enable=false", ["sbc.enable'", "did you mean 'sbc.enabled'"]),
        ("learning_rate=1e-3", ["did you mean 'ppo.learning_rate'"]),
        ("scael=smoke", ["did you mean 'scale'"]),
        ("motions.clips.idle.lopping=true", ["did you mean 'motions.clips.NAME.looping'"]),
        ("sbc=false", ["sbc is a group of keys", "sbc.enabled"]),
        ("scale=lap", ["scale=lap", "demo, laptop, paper, precise, smoke, transfer"]),
        ("motions=bultin", ["motions=bultin", "did you mean 'builtin'"]),
        ("motions=no/such.yaml", ["no/such.yaml", "no such file"]),
        ("num_envs=many", ["num_envs=many", "an integer"]),
        ("num_envs=2.5", ["num_envs=2.5", "an integer"]),
        ("num_envs=null", ["num_envs=null", "an integer"]),
        ("sbc.enabled=maybe", ["sbc.enabled=maybe", "true or false"]),
        ("network.hidden=64", ["network.hidden=64", "a list of integers"]),
        ("num_envs=-4", ["num_envs=-4", "at least 1"]),
        ("task.stay_probability=1.5", ["task.stay_probability=1.5", "from 0 to 1"]),
        ("ppo.learning_rate=.inf", ["ppo.learning_rate=inf", "above 0"]),
        ("network.hidden=[]", ["network.hidden=[]", "at least one"]),
        ("evaluation.robustness_bracket=[-4]", ["evaluation.robustness_bracket=[-4.0]", "2 numbers"]),
        ("evaluation.robustness_bracket=[-2,-4]", ["command line", "[-2.0,-4.0] is reversed", "use [-4.0,-2.0]"]),
        ("evaluation.robustness_resolution=0", ["evaluation.robustness_resolution=0", "above 0"]),
        ("curriculum.start=[1,2]", ["curriculum.start=[1.0,2.0]", "3 numbers"]),
        ("curriculum.floor=[9,9,9]", ["curriculum.floor", "curriculum.start"]),
        ("runtime=thread", ["runtime=thread", "ray, local"]),
        ("device=gpu", ["device=gpu", "auto, cpu, cuda"]),
        ("action.mode=relative", ["action.mode=relative", "absolute, target, current"]),
        ("sbc.gap_weighting=none", ["balanced, inverse, uniform"]),
        ("fall.ignore_bodies=[swrd]", ["fall.ignore_bodies=[swrd]", "sword"]),
        ("num_workers=9", ["num_workers=9", "num_envs=8", "lower num_workers"]),
        ("budget.iterations=null", ["no budget", "budget.samples"]),
        ("motions.clips.extra.start=0", ["motions.clips.extra.file", "missing"]),
        ("horizon", ["'horizon'", "key=value"]),
    ],
)
def test_bad_input_is_one_line_with_the_key_and_what_is_allowed(argument, words):
    message = error_of("scale=smoke", argument)
    for word in words:
        assert word in message


def test_errors_name_the_file_that_a_value_comes_from():
    with pytest.raises(InputError, match="mine.yaml .row a.: num_envs=0"):
        build([command_line(["scale=smoke"]), Layer({"num_envs": 0}, "mine.yaml (row a)")])


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    assert "device=cpu" in error_of("scale=smoke", "device=cuda")
    # the cluster is asked instead, see orchestrator.cluster
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    assert of("scale=smoke", "device=cuda").device == "cuda"


@pytest.mark.parametrize("scale", ["smoke", "demo", "laptop", "paper", "transfer"])
@pytest.mark.parametrize("motions", ["builtin", "reallusion", "reallusion_all", "deepmimic", "three"])
def test_a_saved_configuration_loads_as_it_was(tmp_path, scale, motions):
    config = of(f"scale={scale}", f"motions={motions}", "ppo.clip=0.1234567890123456", "seed=7")
    save(config, tmp_path / "config.yaml")
    assert load(tmp_path / "config.yaml") == config


def test_load_takes_overrides_and_refuses_files(tmp_path):
    save(of("scale=smoke"), tmp_path / "config.yaml")
    assert load(tmp_path / "config.yaml", ["evaluation.max_tasks=3"]).evaluation.max_tasks == 3
    with pytest.raises(InputError, match="scale="):
        load(tmp_path / "config.yaml", ["scale=paper"])
    with pytest.raises(InputError, match="missing.yaml"):
        load(tmp_path / "missing.yaml")


def test_a_broken_file_is_one_line(tmp_path):
    path = tmp_path / "motions.yaml"
    path.write_text("name: [")
    assert "not YAML" in error_of(f"motions={path}")
    path.write_text("- a\n- b\n")
    assert "mapping" in error_of(f"motions={path}")
    path.write_text("name: own\nclip: {}\n")
    assert "did you mean" in error_of(f"motions={path}")


def test_every_key_is_documented_and_every_number_has_a_range():
    for name, key in all_keys().items():
        assert key.doc, f"{name} has no documentation"
        if not name.startswith("motions.") and key.plain_type not in (bool, str):
            assert name in RULES, f"{name} has no rule in orchestrator.validate"
    config = of("scale=smoke")
    for name in RULES:
        operator.attrgetter(name)(config)


def test_the_list_of_keys_names_all(capsys):
    text = settings.describe()
    for name in ("sbc.enabled", "motions.clips.NAME.cancel", "budget.samples", "evaluation.log_sigma"):
        assert f"{name} = " in text


def test_suggestions():
    assert find_key("motions.clips.idle.start").name == "motions.clips.NAME.start"
    assert find_key("motions.clips.idle.begin") is None
    assert suggestion("xyzzy", ["alpha", "beta"]) == ""


@pytest.mark.parametrize(
    "values, words",
    [
        (["physics.sole=0"], "arrival.weight=0.1.*hard feet.*physics.sole=0.02"),
        (["arrival.steps=61"], "arrival.steps=61 is more than an episode's .* lower it"),
        (["reward.key_body_frame=own"], "arrival.weight=0.1 follows.*common frame only.*reward.key_body_frame=common"),
    ],
)
def test_what_the_arrival_gradient_cannot_follow_is_refused(values, words):
    with pytest.raises(InputError, match=words):
        build([command_line(["scale=smoke", "arrival.weight=0.1", "physics.sole=0.02", *values])])
    build([command_line(["scale=smoke", "arrival.weight=0", *values])])
