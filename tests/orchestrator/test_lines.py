"""A full disk leaves whole lines in the file, and one line of text to the user."""

import json

import pytest
from disk import largest_file

from motion.errors import InputError
from orchestrator.lines import LineFile


@pytest.mark.parametrize("room", [0, 1, 30, 59])
def test_a_line_that_does_not_fit_leaves_no_part_of_it(room, tmp_path):
    path = tmp_path / "metrics.jsonl"
    line = json.dumps({"text": "x" * 47}) + "\n"
    assert len(line) == 60
    with LineFile(path) as file:
        file.write(line)
        with largest_file(60 + room), pytest.raises(InputError, match="free space") as error:
            file.write(line)
        assert str(path) in str(error.value) and "\n" not in str(error.value)
        assert path.read_text() == line
    # closing did not try again, and with space there is room for more
    with LineFile(path) as file:
        file.write(line)
        file.sync()
    assert path.read_text() == 2 * line
