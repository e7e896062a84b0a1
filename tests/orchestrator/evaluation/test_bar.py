"""The bar of an evaluation: in place on a terminal, plain lines elsewhere, the time left from this command's rate."""

import io

from orchestrator.evaluation.bar import Bar


def bar_of(interactive, total=1000, done=0):
    now, stream = [0.0], io.StringIO()
    return Bar(total, done, stream, interactive, lambda: now[0]), now, stream


def test_the_time_left_is_by_what_this_command_has_done():
    bar, now, stream = bar_of(False, done=500)
    with bar:
        now[0] = 20.0
        bar.advance(100, 2000)
        assert stream.getvalue().splitlines() == [
            "evaluating [############------------]  50%  500/1,000 tasks",
            "evaluating [##############----------]  60%  600/1,000 tasks  100 steps/s  80 s left",
        ]


def test_lines_are_rare_where_there_is_no_terminal_but_the_last_is_there():
    bar, now, stream = bar_of(False)
    with bar:
        for _ in range(50):
            now[0] += 1.0
            bar.advance(20, 100)
        for _ in range(30):
            now[0] += 1.0
            bar.say("is every task reached?")
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1 + 5 + 3 and "\r" not in stream.getvalue()
    assert "100%  1,000/1,000 tasks" in lines[5] and "left" not in lines[5]


def test_a_terminal_has_one_line_that_changes():
    bar, now, stream = bar_of(True)
    with bar:
        for _ in range(4):
            now[0] += 1.0
            bar.advance(250, 100)
        bar.say("is every task reached?")
    text = stream.getvalue()
    assert text.count("\n") == 1 and text.endswith("is every task reached?\n") and text.count("\r\x1b[K") == 6


def test_nobody_reading_does_not_stop_the_evaluation():
    bar, now, stream = bar_of(True)
    with bar:
        stream.close()
        bar.advance(1000, 1)
