"""A sweep's file and command line."""

import pytest

from motion.errors import InputError
from orchestrator.plan import read_plan
from orchestrator.settings import command_line

SWEEP = """
name: two
base: {scale: smoke}
seeds: [3, 4]
rows:
  first: {}
  second: {sbc.enabled: false, ppo: {clip: 0.3}}
"""


def plan_of(tmp_path, text=SWEEP, *arguments):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    return read_plan(str(path), command_line([f"out={tmp_path}/out", *arguments]))


def error_of(*arguments):
    with pytest.raises(InputError) as caught:
        plan_of(*arguments)
    return str(caught.value)


def test_a_run_per_row_and_seed(tmp_path):
    plan = plan_of(tmp_path)
    names = [run.name for run in plan.runs]
    assert names == ["first-seed3", "second-seed3", "first-seed4", "second-seed4"]
    assert [run.folder for run in plan.runs] == [tmp_path / "out" / name for name in names]
    second = plan.runs[1].config
    assert (second.row, second.seed, second.sbc.enabled, second.ppo.clip) == ("second", 3, False, 0.3)


def test_the_command_line_chooses_rows_and_seeds_and_wins(tmp_path):
    plan = plan_of(tmp_path, SWEEP, "rows=[second]", "seeds=[0,1]", "ppo.clip=0.4")
    assert [run.name for run in plan.runs] == ["second-seed0", "second-seed1"]
    assert plan.runs[0].config.ppo.clip == 0.4
    assert plan_of(tmp_path, SWEEP, "seed=9").seeds == (9,)
    assert plan_of(tmp_path, SWEEP, "rows=first").rows == ("first",)


def test_a_row_may_have_seeds_of_its_own_which_the_command_line_replaces(tmp_path):
    text = "base: {scale: smoke}\nrows:\n  first: {seeds: [0, 2]}\n  second: {sbc.enabled: false}\n"
    plan = plan_of(tmp_path, text)
    assert [run.name for run in plan.runs] == ["first-seed0", "second-seed0", "first-seed2"]
    assert plan.seeds == (0, 2)
    names = [run.name for run in plan_of(tmp_path, text, "seeds=[5]").runs]
    assert names == ["first-seed5", "second-seed5"]
    with pytest.raises(InputError, match=r"rows.first.seeds=\[0,0\] must be different integers"):
        plan_of(tmp_path, text.replace("[0, 2]", "[0, 0]"))


def test_budget_of_the_file(tmp_path):
    assert plan_of(tmp_path, SWEEP + "budget: {iterations: 5}\n").runs[0].config.total_iterations == 5
    assert (
        plan_of(tmp_path, SWEEP + "budget: {iterations: 5}\n", "budget.iterations=2").runs[0].config.total_iterations
        == 2
    )


def test_the_projects_ablation(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = read_plan("sweeps/ablation.yaml", command_line([]))
    assert plan.rows == ("ours", "no_sbc", "no_urp", "no_tr")
    assert plan.out == tmp_path / "runs" / "ablation"
    switches = [(r.config.sbc.enabled, r.config.reward.upper_body_penalty, r.config.reward.tremble) for r in plan.runs]
    assert switches == [(True, True, True), (False, True, True), (True, False, True), (True, True, False)]
    assert all(run.config.scale == "laptop" and run.config.motions.name == "builtin" for run in plan.runs)


def test_wrong_files(tmp_path):
    with pytest.raises(InputError, match="nowhere.yaml"):
        read_plan("nowhere.yaml", command_line([]))
    assert "not YAML" in error_of(tmp_path, "rows: [")
    assert "mapping" in error_of(tmp_path, "- a")
    assert "did you mean 'rows'" in error_of(tmp_path, "row: {}")
    assert "rows must be" in error_of(tmp_path, "name: x")
    assert "rows must be" in error_of(tmp_path, "rows: {}")
    assert "row 'a/b'" in error_of(tmp_path, "rows: {a/b: {}}")
    assert "must not set seed" in error_of(tmp_path, "rows: {a: {seed: 1}}")
    assert "did you mean 'sbc.enabled'" in error_of(tmp_path, "rows: {a: {sbc.enabld: true}}")
    assert "(row a)" in error_of(tmp_path, "base: {scale: smoke}\nrows: {a: {num_envs: 0}}")
    assert "seeds=[]" in error_of(tmp_path, SWEEP.replace("[3, 4]", "[]"))


def test_wrong_command_lines(tmp_path):
    message = error_of(tmp_path, SWEEP, "rows=[first,secnd]")
    assert "no row 'secnd'" in message and "did you mean 'second'" in message and "first, second" in message
    assert "seeds=[1,1]" in error_of(tmp_path, SWEEP, "seeds=[1,1]")
    assert "not both" in error_of(tmp_path, SWEEP, "seeds=[1]", "seed=1")
    assert "seed=[-1]" in error_of(tmp_path, SWEEP, "seed=-1")
