"""`python -m orchestrator.sweep` and `... .train` as a user runs them: bad input, help, failure, a stop."""

import signal
import time

import pytest
from commands import lines_of, run, start, wait_for

from motion.errors import InputError
from orchestrator import mlflow_store
from orchestrator.sweep import main


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.yaml"], "nowhere.yaml"),
        (["sweeps/ablation.yaml", "scale=smoke", "num_workers=8", "worker_threads=64"], "lower num_workers"),
    ],
)
def test_bad_input_is_answered_with_one_line(tmp_path, arguments, words):
    """Before any actor, and, of what only the cluster can tell, right after it has been asked."""
    status, output = run("sweep", tmp_path, *arguments)
    errors = [line for line in output.splitlines() if line.startswith("error: ")]
    assert status == 2 and len(errors) == 1 and words in errors[0], output
    assert "Traceback" not in output
    assert not list(tmp_path.rglob("metrics.jsonl"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "sweeps/ablation.yaml"),
        (["sweeps/ablation.yaml", "scale=smoke", "sbc.enable=1"], "did you mean 'sbc.enabled'"),
        (["sweeps/ablation.yaml", "scale=smoke", "rows=[our]"], "did you mean 'ours'"),
        (["sweeps/ablation.yaml", "scale=smoke", "curriculum.scope=clip"], "curriculum.scope"),
        (["sweeps/ablation.yaml", "scale=smoke", "motions=reallusion", "motions.dir=nowhere"], "motions.dir"),
        (["sweeps/ablation.yaml", "scale=smoke", "motions.clips.stab.cancel=[0,99]"], "motions.clips.stab.cancel"),
        (["sweeps/ablation.yaml", "scale=smoke", "out=/proc/nowhere"], "choose another out="),
    ],
)
def test_bad_input_is_an_error_of_one_line_that_names_it(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        main(arguments)
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("metrics.jsonl"))


@pytest.mark.parametrize("module", ["sweep", "train"])
def test_help(tmp_path, module):
    status, output = run(module, tmp_path, "--help")
    assert status == 0 and "usage:" in output and "runs/" in output


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_failing_row_does_not_stop_the_others(tmp_path):
    broken = tmp_path / "out" / "ours-seed0" / "checkpoints"
    broken.mkdir(parents=True)
    (broken / "00000001.pt").write_text("not a checkpoint")
    arguments = ["sweeps/ablation.yaml", "scale=smoke", "out=out", "rows=[ours,no_tr]", "runtime=local"]
    arguments += ["report.enabled=false", "tracking.register_model=false"]
    status, output = run("sweep", tmp_path, *arguments, "tracking.uri=http://127.0.0.1:9")
    assert status == 1
    assert "does not answer; training goes on" in output
    assert "* ours-seed0: failed: InputError" in (tmp_path / "out" / "table.md").read_text()
    assert "Traceback" in (tmp_path / "out" / "ours-seed0" / "error.txt").read_text()
    assert (tmp_path / "out" / "no_tr-seed0" / "evaluation.json").exists()


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_stopped_run_says_how_to_continue_and_does(tmp_path):
    arguments = ["scale=smoke", "runtime=local", "out=run", "budget.iterations=150", "checkpoint.every=20"]
    arguments += ["tracking.register_model=false"]
    process = start("train", tmp_path, *arguments)
    wait_for(lambda: lines_of(tmp_path / "run") >= 30, process)
    process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 143 and time.monotonic() - began < 10
    assert "the same command continues: python -m orchestrator.train scale=smoke" in output
    assert not (tmp_path / "run" / "error.txt").exists()
    assert lines_of(tmp_path / "run") == int(sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))[-1].stem)
    status, output = run("train", tmp_path, "resume=run")
    assert status == 0 and lines_of(tmp_path / "run") == 150
    assert run("train", tmp_path, *arguments)[0] == 0  # the same command finds it finished
    assert "at the final accuracy: FRPD" in output
    client = mlflow_store.make_client(f"sqlite:///{tmp_path}/mlflow.db")
    (logged,) = client.search_runs([client.get_experiment_by_name("train").experiment_id])
    assert [m.step for m in client.get_metric_history(logged.info.run_id, "iteration")] == list(range(1, 151))
