"""The command line: what it writes can be used, and bad input is one line and status 2."""

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from motion.onehop import cli
from motion.onehop.cli import Progress, load_clips, main
from motion.onehop.table import LookupTable

PROJECT = Path(__file__).parents[3]
SEARCH = ["--fps", "15", "--blend", "6", "--max-stay", "8"]


@pytest.fixture(scope="module")
def motions(tmp_path_factory):
    """A state-machine file of two built-in clips and three of their four pairs, with beats and genres."""
    path = tmp_path_factory.mktemp("motions") / "two.yaml"
    path.write_text(
        "name: two\n"
        "groups: [[idle, stab], [stab, idle], [idle, idle]]\n"
        "clips:\n"
        "  idle: {file: 'builtin:idle', looping: true, beats: [0.0, 1.0, 2.0], genre: calm}\n"
        "  stab: {file: 'builtin:stab', beats: [0.5, 1.0], genre: fight}\n"
    )
    return path


@pytest.fixture(scope="module")
def table(motions):
    path = motions.parent / "two.onehop"
    assert main(["build", "--motions", str(motions), *SEARCH, "--out", str(path)]) == 0
    return path


def test_build_writes_a_table_of_the_files_pairs_that_opens(motions, table, capsys):
    clips, pairs = load_clips(str(motions), None, 15)
    opened = LookupTable.open(table, clips)
    assert sorted(opened.pairs) == sorted(pairs) == [(0, 0), (0, 1), (1, 0)]
    assert opened.config.blend == 6 and opened.config.max_stay == 8 and opened.config.hops == 1


def test_query_prints_the_tables_transition(motions, table, capsys):
    clips, _ = load_clips(str(motions), None, 15)
    arguments = ["query", str(table), "--motions", str(motions), "--fps", "15", "--from", "idle", "--to", "stab"]
    assert main([*arguments, "--frame", "7", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    found = LookupTable.open(table, clips).query("idle", "stab", 7)
    assert answer["feasible"] == found.feasible and answer["duration"] == found.duration
    assert [row["frame"] for row in answer["blends"]] == [blend.frame for blend in found.blends]
    assert [row["clip"] for row in answer["blends"]] == [clips.names[blend.clip] for blend in found.blends]
    assert main([*arguments, "--frame", "7"]) == 0
    text = capsys.readouterr().out
    assert "stab alone" in text and f"after {found.duration:4d} frames" in text


def test_the_options_of_the_search_reach_it(motions, tmp_path, monkeypatch):
    seen = []

    def build(clips, pairs, config, progress):
        seen.append((clips, pairs, config))
        raise KeyboardInterrupt

    monkeypatch.setattr("motion.onehop.search.build", build)
    arguments = ["--motions", str(motions), "--fps", "20", "--blend", "5", "--max-stay", "3", "--weight", "0.5"]
    arguments += ["--regime", "fixed", "--hops", "2", "--beats", "--genre-cost", "0.25"]
    assert main(["build", *arguments, "--out", str(tmp_path / "x")]) == 130
    clips, _, config = seen[0]
    assert (config.blend, config.max_stay, config.weight, config.regime, config.hops) == (5, 3, 0.5, "fixed", 2)
    assert config.beats and config.genre_cost == 0.25 and clips.fps == 20
    assert clips.genres == ("calm", "fight") and [list(beats) for beats in clips.beats] == [[0, 20, 40], [10, 20]]
    main(["build", "--weight", "default", "--motions", str(motions), "--out", str(tmp_path / "x")])
    assert seen[1][2].weight is None


BAD = [  # arguments, what the line says
    (["build"], "--out"),
    (["build", "--out", "{missing}/x.onehop"], "there is no folder"),
    (["build", "--out", "{folder}"], "is a folder"),
    (["build", "--motions", "builtim", "--out", "{out}"], "did you mean builtin"),
    (["build", "--motions", "{missing}.yaml", "--out", "{out}"], "no such file"),
    (["build", "--motions", "reallusion", "--out", "{out}"], "motions.dir"),
    (["build", "--motions", "reallusion", "--dir", "{missing}", "--out", "{out}"], "is not a folder"),
    (["build", "--fps", "0", "--out", "{out}"], "--fps"),
    (["build", "--blend", "2.5", "--out", "{out}"], "--blend"),
    (["build", "--max-stay", "-1", "--out", "{out}"], "--max-stay"),
    (["build", "--weight", "heavy", "--out", "{out}"], "--weight"),
    (["build", "--weight", "nan", "--out", "{out}"], "--weight"),
    (["build", "--hops", "3", "--out", "{out}"], "--hops"),
    (["build", "--beats", "--out", "{out}"], "beats"),
    (["build", "--genre-cost", "1", "--out", "{out}"], "genre"),
    (["build", "--speed", "1", "--out", "{out}"], "--speed"),
    (["build", "--motions", "{broken}", "--out", "{out}"], "not YAML at line"),
    (["build", "--motions", "{list}", "--out", "{out}"], "no mapping `clips:`"),
    (["build", "--motions", "{typo}", "--out", "{out}"], "loping"),
    (["build", "--motions", "{halfbeats}", "--out", "{out}"], "clips.stab.beats: is missing"),
    (["build", "--motions", "{badbeats}", "--out", "{out}"], "clips.idle.beats"),
    (["query", "{missing}.onehop", "--from", "idle", "--to", "stab"], "missing.onehop"),
    (["query", "{broken}", "--from", "idle", "--to", "stab"], "not a one-hop table"),
    (["query", "{table}", "--motions", "{motions}", "--from", "idle", "--to", "stab"], "fps"),
    (["query", "{table}", "--motions", "{motions}", "--fps", "15", "--from", "idle", "--to", "fly"], "fly"),
    (["query", "{table}", "--motions", "{motions}", "--fps", "15", "--from", "stab", "--to", "stab"], "stab -> stab"),
    (
        "query {table} --motions {motions} --fps 15 --from stab --to idle --frame 99".split(),
        "trigger frame 99",
    ),
    (["fly"], "fly"),
    ([], "build|query|report|bench"),
]


@pytest.mark.parametrize("arguments, words", BAD, ids=[" ".join(row[0]) for row in BAD])
def test_bad_input_is_one_clear_line_and_status_2(arguments, words, motions, table, tmp_path, capsys):
    files = {
        "broken": "clips: [1\n  : x",
        "list": "[1, 2]",
        "typo": "name: t\nclips: {idle: {file: 'builtin:idle', loping: true}}",
        "halfbeats": "name: t\nclips: {idle: {file: 'builtin:idle', beats: [1]}, stab: {file: 'builtin:stab'}}",
        "badbeats": "name: t\nclips: {idle: {file: 'builtin:idle', beats: often}}",
    }
    names = {"missing": tmp_path / "missing", "folder": tmp_path, "out": tmp_path / "x.onehop", "table": table}
    for key, text in files.items():
        names[key] = tmp_path / f"{key}.yaml"
        names[key].write_text(text)
    try:
        status = main([text.format(**names, motions=motions) for text in arguments])
    except SystemExit as end:
        status = end.code
    shown = capsys.readouterr()
    assert status == 2
    assert shown.out == "" and shown.err.count("\n") == 1 and shown.err.startswith("error: ")
    assert words in shown.err
    assert not (tmp_path / "x.onehop").exists()


@pytest.mark.parametrize("command", [[], ["build"], ["query"], ["report"]], ids=str)
def test_help_has_examples_that_parse(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command, "--help"])
    assert end.value.code == 0
    examples = re.findall(r"^  python -m motion\.onehop (.*?)(?:   .*)?$", capsys.readouterr().out, re.M)
    assert examples
    for example in examples:
        if not example.startswith("bench"):
            cli.parser().parse_args(example.split())


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_drawn_on_a_terminal_only_and_wiped_at_the_end():
    for stream, drawn in ((io.StringIO(), False), (Terminal(), True)):
        with Progress(stream) as progress:
            progress("searching", 3, 4)
        assert ("75%" in stream.getvalue()) == drawn
        assert stream.getvalue() == "" or stream.getvalue().endswith("\r\x1b[K")


def test_it_runs_as_a_module_and_imports_no_physics_learning_or_drawing_package():
    program = (
        "import sys, motion.onehop.cli, motion.onehop.player, motion.onehop.search, motion.onehop.table\n"
        "print(sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=PROJECT, capture_output=True, text=True, check=True)
    assert not {"torch", "ray", "mujoco", "matplotlib", "orchestrator"} & set(eval(done.stdout))
    done = subprocess.run(
        [sys.executable, "-m", "motion.onehop", "build"], cwd=PROJECT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1
