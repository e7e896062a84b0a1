"""When a run's folder is new, continued, finished or refused."""

import json
import os
import subprocess
import sys

import pytest

from motion.errors import InputError
from orchestrator import folder
from orchestrator.settings import build, command_line, load


def config_of(*arguments):
    return build([command_line(["scale=smoke", *arguments])])


def finished(path, *arguments):
    folder.prepare(path, config_of(*arguments))
    lines = [json.dumps({"iteration": i}) for i in (1, 2, 3)]
    folder.metrics_path(path).write_text("\n".join(lines) + "\n")
    folder.evaluation_path(path).write_text('{"iterations": 3}')


def test_new_unfinished_finished(tmp_path):
    assert folder.state_of(tmp_path / "run", config_of()) == folder.NEW
    folder.prepare(tmp_path / "run", config_of())
    assert folder.state_of(tmp_path / "run", config_of()) == folder.UNFINISHED
    finished(tmp_path / "run")
    assert folder.state_of(tmp_path / "run", config_of()) == folder.FINISHED


def test_another_configuration_is_refused_with_key_and_remedy(tmp_path):
    finished(tmp_path)
    with pytest.raises(InputError, match="ppo.clip=0.2, asked for ppo.clip=0.3; choose another out="):
        folder.state_of(tmp_path, config_of("ppo.clip=0.3"))


def test_what_changes_no_number_may_change(tmp_path):
    finished(tmp_path, "device=cpu")
    same = config_of("runtime=local", "worker_threads=2", "checkpoint.keep=9", "tracking.enabled=false", "device=auto")
    assert folder.state_of(tmp_path, same) == folder.FINISHED


def test_a_higher_budget_continues_and_a_lower_one_is_refused(tmp_path):
    finished(tmp_path)
    more = config_of("budget.iterations=5")
    assert folder.state_of(tmp_path, more) == folder.UNFINISHED
    with pytest.raises(InputError, match="budget"):
        folder.state_of(tmp_path, config_of("budget.iterations=2"))
    folder.prepare(tmp_path, more)
    assert not folder.evaluation_path(tmp_path).exists()
    assert load(folder.config_path(tmp_path)) == more


def test_an_evaluation_of_a_run_half_done_does_not_finish_it(tmp_path):
    finished(tmp_path)
    for content in ('{"iterations": 2}', "{}", '{"iterat'):
        folder.evaluation_path(tmp_path).write_text(content)
        assert folder.state_of(tmp_path, config_of()) == folder.UNFINISHED


def test_another_evaluation_needs_only_that(tmp_path):
    finished(tmp_path)
    assert folder.state_of(tmp_path, config_of("evaluation.max_tasks=4")) == folder.UNFINISHED


def test_metrics_without_configuration_are_refused(tmp_path):
    folder.metrics_path(tmp_path).write_text("")
    with pytest.raises(InputError, match="no config.yaml"):
        folder.state_of(tmp_path, config_of())


def test_iterations_done_ignores_half_a_line(tmp_path):
    assert folder.iterations_done(tmp_path) == 0
    folder.metrics_path(tmp_path).write_text('{"iteration": 1}\n{"iteration": 2}\n{"iterat')
    assert folder.iterations_done(tmp_path) == 2


def test_an_unwritable_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        folder.check_writable(tmp_path / "file" / "out")
    if os.geteuid() != 0:
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(InputError, match="choose another out="):
            folder.check_writable(tmp_path / "closed")


def test_a_folder_has_one_owner_and_a_dead_one_lets_go(tmp_path):
    code = f"import sys, time\nfrom orchestrator.folder import exclusive\nwith exclusive({str(tmp_path)!r}):\n"
    code += "    print('held', flush=True)\n    time.sleep(60)\n"
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(InputError, match="another process"), folder.exclusive(tmp_path):
        pass
    holder.kill()
    holder.wait()
    with folder.exclusive(tmp_path, wait=5):
        pass


def test_a_configuration_of_an_older_version_with_a_key_since_removed_still_loads(tmp_path):
    folder.prepare(tmp_path, config_of())
    path = folder.config_path(tmp_path)
    path.write_text(path.read_text().replace("evaluation:\n", "evaluation:\n  robustness_log_sigmas: [-3.7, -2.9]\n"))
    assert "robustness_log_sigmas" in path.read_text()
    assert folder.state_of(tmp_path, config_of()) == folder.UNFINISHED
