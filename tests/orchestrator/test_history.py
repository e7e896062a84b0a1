"""metrics.jsonl has each iteration once, whatever is cut off, repeated or lost."""

import json
import logging

from orchestrator.history import History


def line(iteration, value=0.5, seconds=1.0):
    return {"iteration": iteration, "return/mean": value, "perf/seconds": seconds * iteration}


def iterations(path):
    return [json.loads(text)["iteration"] for text in path.read_text().splitlines()]


def written(path, count):
    with History(path, 0) as history:
        for iteration in range(1, count + 1):
            history.write(line(iteration))


def test_an_iteration_done_again_keeps_its_line(tmp_path, caplog):
    path = tmp_path / "metrics.jsonl"
    written(path, 5)
    before = path.read_bytes()
    with History(path, 2) as history:
        assert (history.last, history.seconds) == (5, 5.0)
        for iteration in (3, 4, 5):
            history.write(line(iteration, seconds=7.0))  # the clock may differ
        assert path.read_bytes() == before
        history.write(line(6))
    assert iterations(path) == [1, 2, 3, 4, 5, 6] and not caplog.records


def test_a_number_that_comes_out_otherwise_is_said_once(tmp_path, caplog):
    path = tmp_path / "metrics.jsonl"
    written(path, 4)
    with caplog.at_level(logging.WARNING), History(path, 1) as history:
        for iteration in (2, 3, 4):
            history.write(line(iteration, value=0.25))
    (record,) = caplog.records
    assert all(text in record.getMessage() for text in ("iteration 2", "return/mean=0.5 before", "0.25 now"))
    assert iterations(path) == [1, 2, 3, 4]


def test_a_line_that_a_crash_cut_off_goes_and_is_written_again(tmp_path):
    path = tmp_path / "metrics.jsonl"
    written(path, 3)
    with open(path, "ab") as file:
        file.write(b'{"iteration": 4, "ret')
    with History(path, 3) as history:
        assert history.last == 3
        history.write(line(4))
    assert iterations(path) == [1, 2, 3, 4]
