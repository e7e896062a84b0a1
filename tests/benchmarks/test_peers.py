"""What `python -m benchmarks.peers` measures is what happened: samples, fresh tasks, iterations, lines, processes."""

import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import processes
from benchmarks.peers import ceiling, measure, shadow
from benchmarks.peers.__main__ import achievement_curve, compare
from benchmarks.peers.child import POLICIES
from benchmarks.peers.libraries import build_lines
from benchmarks.peers.lines import count_lines
from benchmarks.peers.record import Writer, read
from benchmarks.peers.task import PLAIN, WARM_UP, build_config, first_thresholds
from orchestrator.settings import build, command_line
from workers.config import ObservationConfig
from workers.types import REACHED

STEPS = 80


@pytest.mark.parametrize("same_step", [True, False])
def test_recorded_environments_count_what_they_did(same_step, make_config, easy, tmp_path):
    """Samples without the steps that only begin an episode, ends of fresh tasks, an iteration where a batch is full."""
    gymnasium = pytest.importorskip("gymnasium")
    from benchmarks.peers.recorded_env import Enough, Recorded
    from workers.vector_env import TransitionVectorEnv

    modes = gymnasium.vector.AutoresetMode
    mode = modes.SAME_STEP if same_step else modes.NEXT_STEP
    plain = TransitionVectorEnv(make_config({"task.max_steps": 6}), easy, 5, autoreset_mode=mode)
    asked = []
    env = Recorded(plain, tmp_path / "a.record", batch=20, enough=lambda: asked.append(1) or len(asked) > 8)
    env.reset(seed=1)
    generator, samples, ended, reached, waiting = np.random.default_rng(0), 0, 0, 0, np.zeros(5, bool)
    with pytest.raises(Enough):
        for _ in range(STEPS):
            result = env.step(generator.normal(size=(5, 31), scale=0.5))
            for i in range(5):
                samples += not waiting[i]
                if result[2][i]:
                    info = result[4]["final_info"] if same_step else result[4]
                    ended += not info["retained"][i]
                    reached += bool(info["reached"][i] and not info["retained"][i])
            waiting = result[2] if not same_step else waiting
    record = read([tmp_path / "a.record"])
    assert record.at(time.monotonic()) == (samples, ended, reached)
    assert ended > reached > 0
    assert len(record.begins) == len(asked) == 9
    collected = np.diff([record.at(moment)[0] for moment in record.begins])
    assert (collected >= 20).all() and (collected < 25).all()


def test_records_of_several_processes_are_read_as_one_run(tmp_path):
    one, other = Writer(tmp_path / "1.record"), Writer(tmp_path / "2.record")
    for begin in range(4):
        one.write(0, 0, 0, True, at=begin)
        one.write(10, 4, 1 + begin, False, at=begin + 0.5)
        other.write(0, 0, 0, True, at=begin)
        other.write(10, 2, 1, False, at=begin + 0.6)
    one.write(0, 0, 0, True, at=4)
    with open(tmp_path / "1.record", "ab") as file:
        file.write(b"half a record")
    record = read(tmp_path.glob("*.record"))
    np.testing.assert_array_equal(record.begins, [0, 1, 2, 3, 4])
    assert record.at(0.4) == (0, 0, 0) and record.at(2.0) == (40, 12, 5)
    assert record.when(40) == 2.0 and record.when(41) == 3.0 and record.when(81) is None
    assert record.achievement(3.0, 20) == (3 + 1) / 6  # the third iteration alone
    assert record.achievement(3.0, 1000) == (1 + 2 + 3 + 3) / 18
    assert record.achievement(0.0, 20) is None


def test_equal_learning_took_as_long_as_the_first_line_took_to_the_rate_of_each(tmp_path):
    """Rates that rise by 0.01 an iteration in the first line and by 0.002 in the other, over windows of ten."""
    config, runs = build_config([]), {}
    samples = 40 * config.samples_per_iteration
    for name, rise, duration in (("fast", 10, 1.0), ("slow", 2, 3.0)):
        writer = Writer(tmp_path / f"{name}.record")
        writer.write(0, 0, 0, True, at=100.0)
        for i in range(1, 41):
            writer.write(config.samples_per_iteration, 1000, rise * i, True, at=100.0 + duration * i)
        record = read([tmp_path / f"{name}.record"])
        runs[name] = measure.Run(tmp_path / name, record, np.array([[0, 0], [500, 1]]), np.array([[0, 1]]), {})
    options = SimpleNamespace(samples=samples, seconds=None, overrides=[])
    figures = compare(runs, config, options)
    fast, slow = (figures["lines"][name] for name in ("fast", "slow"))
    assert fast["achievement_equal_samples"] == pytest.approx(10 * 35.5 / 1000)  # of iterations 31 to 40
    assert slow["achievement_equal_samples"] == pytest.approx(2 * 35.5 / 1000)
    assert fast["first_line_seconds"] == fast["seconds_to_samples"] == 38.0
    # 0.071: 10 i / 1000 over (i - 9 .. i) from i = 11.6 on
    assert slow["first_line_seconds"] == 12 - WARM_UP and slow["seconds_to_samples"] == 38 * 3.0
    assert figures["curve"][0] == (10 - WARM_UP, pytest.approx(0.055)) and len(figures["curve"]) == 31
    better = compare({"slow": runs["slow"], "fast": runs["fast"]}, config, options)
    assert better["lines"]["fast"]["first_line_seconds"] is None


def test_a_learning_curve_by_policies_is_of_the_same_windows(tmp_path, monkeypatch):
    """One pass over all policies, summed up: as if every window had been added up by itself."""
    config, random = build_config([]), np.random.default_rng(0)
    writer = Writer(tmp_path / "a.record")
    writer.write(0, 0, 0, True, at=0.0)
    for i in range(1, 19):
        writer.write(config.samples_per_iteration, 0, 0, True, at=float(i))
    counted = np.stack([random.integers(5, 9, 18), random.integers(0, 5, 18)], axis=1)
    monkeypatch.setattr(shadow, "counts", lambda config, folder, iterations: counted[np.array(iterations) - 1])
    (tmp_path / POLICIES).mkdir()
    run = measure.Run(tmp_path, read([tmp_path / "a.record"]), None, None, {})
    curve = achievement_curve(run, config, 16 * config.samples_per_iteration, 4 * config.samples_per_iteration)
    assert [at for at, _ in curve] == [m - WARM_UP for m in range(4, 17)]
    for at, rate in curve:
        last = int(at) + WARM_UP
        ended, reached = counted[last - 4 : last].sum(axis=0)
        assert rate == reached / ended


def test_nobody_is_faster_than_all_cores_at_the_least_that_training_does(monkeypatch):
    """Of each part the median of all rounds, on every core at once; an epoch comes on top of collecting."""
    took = {"physics": [2.0, 9.0, 1.0], "collect": [3.0, 4.0, 8.0], "epoch": [9.0, 0.5, 0.5, 7.0]}
    config = build_config([])
    monkeypatch.setattr(ceiling, "rollout_parts", lambda config: ("collect", lambda threads: "physics"))
    monkeypatch.setattr(ceiling, "epoch", lambda config: lambda: took["epoch"].pop(0))
    monkeypatch.setattr(ceiling, "seconds", lambda work: took[work].pop(0) if isinstance(work, str) else work())
    monkeypatch.setattr(ceiling.os, "cpu_count", lambda: 4)
    samples = 4 * config.samples_per_iteration
    assert ceiling.ceilings(config) == {
        "physics alone": samples / 2.0,
        "collecting alone": samples / 4.0,
        "collecting and one epoch": samples / 4.5,
    }


def test_an_epoch_takes_the_gradient_of_every_weight_by_every_sample_once(monkeypatch):
    config, seen = build_config(["num_envs=24", "ppo.minibatch_size=100"]), []
    original = ceiling.torch.autograd.grad
    monkeypatch.setattr(
        ceiling.torch.autograd, "grad", lambda loss, weights: seen.append(original(loss, weights)) or seen[-1]
    )
    ceiling.epoch(config)()
    batches = -(-config.samples_per_iteration // 100)
    assert len(seen) == 2 * batches and {len(gradients) for gradients in seen} == {6}
    assert all(gradient.abs().sum() > 0 for gradients in seen for gradient in gradients)


@pytest.mark.parametrize("target", ["absolute", "difference"])
def test_a_shadow_counts_the_fresh_tasks_of_the_policies_it_is_given(target, make_config, make_policy, tmp_path):
    """By the policies of the window, in their order, after as many steps as an episode may take, seeing as they do."""
    plain = make_config({"task.max_steps": 16, "curriculum.start": [0.35, 3.0, 1.0]})
    config = replace(plain, observation=ObservationConfig(target=target))
    policies = [make_policy(seed=k, gain=1.0) for k in range(1, 5)]
    for iteration, policy in enumerate(policies, 1):
        shadow.save(tmp_path, iteration, policy, config.observation)
    rollout = shadow.Rollout(
        config, shadow.build_library(shadow.build_state_machine(config.motions)), 8, 8, config.seed + shadow.SEED
    )
    state, counted = rollout.initial_state(0), []
    for policy in [policies[1], policies[1], *policies[1:]]:
        chunk, state = rollout.collect(state, policy, first_thresholds(config))
        counted.append(chunk.outcomes.end[~chunk.outcomes.retained] == REACHED)
    assert shadow.achievement(plain, tmp_path, last=4, window=3) == np.concatenate(counted[2:]).mean()
    assert not shadow.explores_otherwise(config)


def test_the_scale_may_be_changed_and_what_makes_a_line_may_not(tmp_path):
    """In the configuration that Segue's command line comes to, as in that of the others."""
    lines = build_lines("python", "laptop")
    asked = ["scale=laptop", "motions=builtin", "sbc.enabled=true", "curriculum.achievement=0.5"]
    config = build([command_line(lines["segue_plain"].arguments(tmp_path, asked))])
    assert config.scale == build_config(asked).scale == "laptop"
    assert not config.sbc.enabled and config.curriculum.achievement == 1.0
    assert config.ppo.epochs == build_config(asked).ppo.epochs == PLAIN["ppo.epochs"]
    assert build([command_line(lines["segue"].arguments(tmp_path, []))]).scale == build_config([]).scale == "demo"
    assert lines["segue"].title == "Segue (scale=laptop)"


def test_plain_ppo_explores_as_the_others_do_and_the_demo_does_not():
    assert not shadow.explores_otherwise(build_config([]))
    own = {name: line.source.read_text() for name, line in build_lines("python").items() if line.is_segue}
    for key in PLAIN:
        assert f"\n{key}=" in own["segue_plain"] and f"\n{key}=" not in own["segue"]


def test_lines_are_counted_without_blanks_comments_and_docstrings(tmp_path):
    path = tmp_path / "a.py"
    head = '"""Doc\nstring."""\n\n# comment\n'
    path.write_text(head + 'def f(x):  # a line\n    """Doc."""\n    return (\n        "text",\n        x,\n    )\n')
    assert count_lines(path) == 5
    path.with_suffix(".txt").write_text("# comment\n\ncommand\nkey=value\n")
    assert count_lines(path.with_suffix(".txt")) == 2


def until(condition):
    """Wait for a condition; it must come true within 30 s."""
    for _ in range(300):
        if condition():
            return
        time.sleep(0.1)
    raise AssertionError("it did not come true")


def test_processes_of_a_tree_are_found_with_what_they_use():
    inner = "import time; sum(range(10**8)); time.sleep(60)"
    code = f"import subprocess, sys; x = b'1' * 60_000_000; subprocess.run([sys.executable, '-c', {inner!r}])"
    process = subprocess.Popen([sys.executable, "-c", code])
    used = processes.CPU(process.pid)
    try:
        for _ in range(300):
            pids = processes.tree(process.pid)
            if len(pids) == 2 and used.seconds() > 0.2 and processes.memory(pids) > 60:
                break
            time.sleep(0.1)
        assert len(pids) == 2 and used.seconds() > 0.2
        assert 60 < processes.memory(pids) < 200
    finally:
        for pid in processes.tree(process.pid):
            subprocess.run(["kill", str(pid)], check=False)
        process.wait()


def test_what_a_process_has_used_still_counts_when_it_has_ended_and_nobody_waited_for_it():
    """The kernel forgets what such a child has used."""
    inner = "sum(range(10**8)); input()"
    code = (
        "import signal, subprocess, sys; signal.signal(signal.SIGCHLD, signal.SIG_IGN); "
        f"child = subprocess.Popen([sys.executable, '-c', {inner!r}]); sys.stdin.readline(); child.kill(); "
        "sys.stdin.readline()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    used = processes.CPU(process.pid)
    try:
        until(lambda: len(processes.tree(process.pid)) == 2 and used.seconds() > 0.5)
        before = used.seconds()
        process.stdin.write(b"\n")
        process.stdin.flush()
        until(lambda: len(processes.tree(process.pid)) == 1)
        assert used.seconds() >= before
    finally:
        process.kill()
        process.wait()
