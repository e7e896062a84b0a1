"""What the terminal shows of several runs."""

import io
import re

import pytest

from motion.state_machine import build_state_machine
from orchestrator.progress import DONE, EVALUATING, FAILED, RUNNING, Progress, Row, clips, duration, parts, samples
from orchestrator.settings import build, command_line


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def metrics(iteration, **values):
    base = {
        "iteration": iteration,
        "return/mean": 1.25,
        "achievement": 0.5,
        "thresholds/root_position": 0.27,
        "thresholds/key_bodies": 2.7,
        "thresholds/joint_rotation": 0.9,
        "thresholds/tightenings": 1,
        "perf/samples_per_second": 3100.0,
    }
    return base | values


def make(interactive, concurrent=1, **rows):
    clock, stream = Clock(), io.StringIO()
    rows = [Row(name, total, 100) for name, total in (rows or {"a": 100, "bb": 100}).items()]
    return Progress(rows, concurrent, stream, interactive, clock), clock, stream


def test_plain_lines_come_at_most_every_ten_seconds():
    progress, clock, stream = make(False)
    for second in range(30):
        clock.now = float(second)
        progress.update("a", metrics(second + 1))
    lines = [line for line in stream.getvalue().splitlines() if line.startswith("a ")]
    assert [int(re.search(r"(\d+)/100", line)[1]) for line in lines] == [1, 11, 21]
    assert "\x1b" not in stream.getvalue()


def test_a_line_says_what_matters():
    progress, clock, stream = make(False)
    progress.update("a", metrics(1))
    clock.now = 20.0
    progress.update("a", metrics(21))
    line = stream.getvalue().splitlines()[-1]
    for words in (
        "a ",
        "training",
        "21/100",
        "3.1k/s",
        "return   1.25",
        "reached  50%",
        "0.27/2.7/0.9 (1 cuts)",
        "79 s left",
    ):
        assert words in line


def test_an_iteration_without_an_ended_episode_keeps_the_last_values():
    progress, clock, stream = make(False)
    progress.update("a", metrics(1))
    clock.now = 20.0
    progress.update("a", metrics(2, achievement=None) | {"return/mean": None})
    assert "return   1.25" in stream.getvalue().splitlines()[-1]
    progress, _, stream = make(False)
    progress.update("a", metrics(1, achievement=None))
    assert "reached -" in stream.getvalue()


@pytest.mark.parametrize(("concurrent", "words"), [(1, "about 3 min"), (2, "about 97 s")])
def test_the_whole_time_is_said_once_when_speed_is_known(concurrent, words):
    progress, clock, stream = make(False, concurrent)
    progress.update("a", metrics(1))
    for second in range(1, 20):
        clock.now = float(second)
        progress.update("a", metrics(1 + second))
    said = [line for line in stream.getvalue().splitlines() if line.startswith("measured")]
    assert len(said) == 1
    assert "100 samples/s per run" in said[0] and words.replace("97 s", "2 min") in said[0]


def test_the_block_is_drawn_in_place():
    progress, clock, stream = make(True)
    with progress:
        progress.update("a", metrics(1))
        progress.say("hello")
        progress.say("there")
    text = stream.getvalue()
    assert "\x1b[2F\x1b[J" in text
    # what stays on the screen: both lines and one block
    screen = re.split(r"(\x1b\[2F\x1b\[J)", text)
    shown = []
    for part in screen:
        if part.startswith("\x1b"):
            shown = shown[:-2]
        else:
            shown += part.splitlines()
    assert [line.split()[0] for line in shown] == ["hello", "there", "a", "bb"]


def test_states_and_failures_are_said():
    progress, _, stream = make(False)
    progress.state("a", RUNNING)
    progress.state("a", EVALUATING)
    progress.state("a", DONE)
    progress.state("bb", FAILED, "ValueError: no good")
    text = stream.getvalue()
    assert "evaluating" in text and "done" in text and "bb: failed: ValueError: no good" in text


def test_a_closed_output_stops_nothing():
    progress, _, stream = make(False)
    stream.close()
    progress.update("a", metrics(1))


def test_numbers_in_words():
    assert [samples(v) for v in (None, 950, 3123, 2e6)] == ["-", "950", "3.1k", "2.0M"]
    assert [duration(v) for v in (40, 420, 12000, 200000)] == ["40 s", "7 min", "3 h 20 min", "2 d 7 h"]


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["spare_threads=1"], "1 worker x 1 thread (and 1 spare) and one learner on cpu; runtime ray"),
        (["spare_threads=1", "runtime=local"], "1 worker x 1 thread and one learner on cpu; runtime local"),
        (["num_workers=2", "worker_threads=4"], "2 workers x 4 threads and one learner on cpu; runtime ray"),
    ],
)
def test_the_parts_of_a_run(arguments, text):
    assert parts(build([command_line(["scale=smoke", "device=cpu", *arguments])])) == text


def test_a_target_in_the_air_is_named_before_a_run_begins():
    """The built-in dodge jumps: its highest moment is no place to arrive at."""
    config = build([command_line(["scale=smoke", "device=cpu"])])
    assert clips(config) == ["9 clips (builtin)"]
    dodge = next(s.clip for s in build_state_machine(config.motions).states if s.name == "dodge_back")
    config.motions.clips["dodge_back"].start = float(dodge.qpos[:, 2].argmax() / dodge.fps)
    first, line = clips(config)
    assert first == "9 clips (builtin)"
    assert re.match(r"  clip dodge_back floats: its lowest point is 0\.\d\d m above the floor at its start point", line)
