"""Command line of the one-hop transitions: `python -m motion.onehop build|query|report|bench --help`."""

import argparse
import json
import math
import sys
import time
from pathlib import Path

from motion.errors import InputError

EXAMPLES = {
    None: """examples:
  python -m motion.onehop build --out table.onehop                          the nine built-in clips, 60 fps
  python -m motion.onehop build --motions reallusion --dir CLIPS --out table.onehop
  python -m motion.onehop query table.onehop --from idle --to stab --frame 40
  python -m motion.onehop report --out report.html
  python -m motion.onehop bench --json
""",
    "build": """examples:
  python -m motion.onehop build --out table.onehop
  python -m motion.onehop build --motions reallusion --dir CLIPS --hops 2 --out table.onehop
  python -m motion.onehop build --motions mine.yaml --dir CLIPS --regime fixed --beats --out dance.onehop
""",
    "query": """examples:
  python -m motion.onehop query table.onehop --from idle --to stab --frame 40
  python -m motion.onehop query table.onehop --motions reallusion --dir CLIPS --from RunForward --to Atk_Stab --json
""",
    "report": """examples:
  python -m motion.onehop report --out report.html
  python -m motion.onehop report --motions reallusion --dir CLIPS --blend 20 --out report.html
""",
    "bench": """examples:
  python -m motion.onehop bench
  python -m motion.onehop bench --json
""",
}


def main(arguments=None):
    """Runs the command; 0, or 2 after one line on standard error for bad input, or 130 after Ctrl-C."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments[:1] == ["bench"]:
        # its options are its own
        from motion.onehop import bench

        return bench.main(arguments[1:])
    options = parser().parse_args(arguments)
    try:
        return options.run(options)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


class _Parser(argparse.ArgumentParser):
    """One whose errors are one line, as all bad input here."""

    def error(self, message):
        self.exit(2, f"error: {message}; see {self.prog} --help\n")


def parser():
    """The argument parser of all commands."""
    out = _Parser(
        prog="python -m motion.onehop",
        description="One-hop transitions between motion clips (Koyama and Goto 2019).",
        epilog=EXAMPLES[None],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = out.add_subparsers(title="commands", required=True, metavar="build|query|report|bench")

    def add(name, run, words):
        command = commands.add_parser(
            name, help=words, description=words[0].upper() + words[1:] + ".", epilog=EXAMPLES[name],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        command.set_defaults(run=run)
        return command

    build = add("build", run_build, "search the optimal transition of every pair and trigger frame; write the table")
    _clip_options(build)
    _search_options(build)
    build.add_argument("--hops", type=int, default=1, choices=(1, 2), help="hops at most (default 1)")
    build.add_argument("--out", required=True, metavar="FILE", help="the table to write, e.g. table.onehop")

    query = add("query", run_query, "print the transition that a table holds for a trigger")
    query.add_argument("table", help="a file that `build` wrote, from these clips")
    _clip_options(query)
    query.add_argument("--from", dest="source", required=True, metavar="CLIP", help="the clip that is played")
    query.add_argument("--to", dest="destination", required=True, metavar="CLIP", help="the clip that is asked for")
    query.add_argument("--frame", type=int, default=0, help="trigger frame of the source (default 0)")
    query.add_argument("--json", action="store_true", help="print one line of JSON")

    report = add("report", run_report, "write one HTML page: costs, distance map, effect of the weight, film strips")
    _clip_options(report)
    _search_options(report)
    report.add_argument("--out", required=True, metavar="FILE", help="the page to write, e.g. report.html")

    add("bench", None, "time the search and the runtime")
    return out


def _clip_options(command):
    group = command.add_argument_group("clips")
    group.add_argument(
        "--motions", default="builtin", metavar="NAME|PATH",
        help="a file of configs/motions (builtin, reallusion, ...) or the path of such a file (default builtin)",
    )  # fmt: skip
    group.add_argument("--dir", metavar="FOLDER", help="folder of the clips, where the file does not name it")
    group.add_argument("--fps", type=_number(0, above=True), default=60.0, help="frames per second (default 60)")


def _search_options(command):
    group = command.add_argument_group("search")
    whole = _number(1, whole=True)
    group.add_argument("--blend", type=whole, default=30, metavar="FRAMES", help="length b of a blend (default 30)")
    group.add_argument(
        "--max-stay", type=_number(0, whole=True), default=60, metavar="FRAMES", help="largest stay s_max (default 60)"
    )
    group.add_argument(
        "--weight", type=_weight, default=None, metavar="default|NUMBER",
        help="w, m² per frame: larger is more responsive, smaller is smoother (default: the paper's rule)",
    )  # fmt: skip
    group.add_argument(
        "--regime", choices=("start", "fixed"), default="start",
        help="start: the destination's frame 0 is at the trigger (games); fixed: clips keep a common time (music)",
    )  # fmt: skip
    group.add_argument("--beats", action="store_true", help="hops keep the beat (`beats:` of clips, s, in the file)")
    group.add_argument(
        "--genre-cost", type=_number(0), default=0.0, metavar="COST",
        help="m² that a hop of another `genre:` than the destination's costs (default 0)",
    )  # fmt: skip


def _number(least, whole=False, above=False):
    """An argparse type: a number >= `least` (or above it)."""
    kind = "a whole number" if whole else "a number"

    def read(text):
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {kind}") from None
        if not (math.isfinite(value) and (value > least if above else value >= least)):
            raise argparse.ArgumentTypeError(f"{text}: give {kind} {'above' if above else 'of at least'} {least}")
        return value

    return read


def _weight(text):
    return None if text == "default" else _number(0)(text)


# -------------------------------------------------------------------------------------------------------------- clips


def load_clips(motions, folder, fps):
    """(ClipSet at `fps`, [(source, destination)] indices of the file's groups). InputError if they cannot be had."""
    from motion.onehop.cli_motions import read_motions
    from motion.onehop.clips import ClipSet
    from motion.state_machine import build_state_machine

    config, beats, genres = read_motions(motions)
    if folder is not None:
        config.dir = folder
    machine = build_state_machine(config)
    clips = ClipSet.from_clips([_named(state) for state in machine.states], fps, beats=beats, genres=genres)
    return clips, [tuple(map(int, pair)) for pair in machine.groups]


def _named(state):
    from dataclasses import replace

    return replace(state.clip, name=state.name)


def _loaded(options):
    from motion.onehop.types import SearchConfig

    clips, pairs = load_clips(options.motions, options.dir, options.fps)
    config = SearchConfig(
        blend=options.blend, max_stay=options.max_stay, weight=options.weight, regime=options.regime,
        hops=getattr(options, "hops", 1), beats=options.beats, genre_cost=options.genre_cost,
    )  # fmt: skip
    config.check()
    if options.beats and clips.beats is None:
        raise InputError(f"--beats: {options.motions} gives no `beats:` (s) for its clips; add them to every clip")
    if options.genre_cost and clips.genres is None:
        raise InputError(f"--genre-cost: {options.motions} gives no `genre:` for its clips; add it to every clip")
    return clips, pairs, config


# ----------------------------------------------------------------------------------------------------------- commands


def run_build(options):
    from motion.onehop.search import build

    path = _writable(options.out)
    clips, pairs, config = _loaded(options)
    with Progress() as progress:
        table = build(clips, pairs, config, lambda done, total: progress("searching", done, total))
    table.save(path)
    result = table.result
    missing = int((result.hop < 0).sum())
    print(f"{path}: {len(table.pairs)} pairs, {table.triggers} triggers, {table.bytes_per_trigger} bytes each")
    print(f"weight {result.weight:.3e} m² per frame; {missing} triggers without candidate (played directly)")
    return 0


def run_query(options):
    from motion.onehop.table import LookupTable

    clips, _ = load_clips(options.motions, options.dir, options.fps)
    table = LookupTable.open(options.table, clips)
    try:
        found = table.query(options.source, options.destination, options.frame)
    except IndexError as error:
        raise InputError(f"--frame: {error}") from error
    names = clips.names
    blends = [
        {"time": b.time, "clip": names[b.clip], "frame": b.frame, "length": b.length} for b in found.blends
    ]  # fmt: skip
    if options.json:
        print(json.dumps({"feasible": found.feasible, "fps": clips.fps, "duration": found.duration, "blends": blends}))
        return 0
    print(f"{names[found.source]}, frame {found.frame}, to {names[found.destination]} at {clips.fps:g} fps")
    if not found.feasible:
        print("no candidate; the player plays the direct transition:")
    for row in blends:
        print(
            f"  after {row['time']:4d} frames ({row['time'] / clips.fps:.2f} s): blend {row['length']} frames"
            f" into {row['clip']}, from its frame {row['frame']}"
        )
    print(f"  after {found.duration:4d} frames ({found.duration / clips.fps:.2f} s): {names[found.destination]} alone")
    return 0


def run_report(options):
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError("report: needs matplotlib; install it (pip install matplotlib)") from None
    from motion.onehop.report import page
    from motion.onehop.report_data import KINDS, study

    path = _writable(options.out)
    clips, pairs, config = _loaded(options)
    with Progress() as progress:
        found = study(clips, pairs, config, progress)
        content = page(found, Path(str(options.motions)).stem)
    path.write_text(content, encoding="utf-8")
    costs = ", ".join(f"{kind} {found.summary[kind]['cost']:.4f}" for kind in KINDS)
    print(f"{path}: {len(content) / 1e6:.1f} MB; mean cost in m²: {costs}")
    return 0


def _writable(path):
    """The path of a file that will be written; InputError now rather than after the work."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"--out: {path} is a folder; give a file's name in it")
    if not path.absolute().parent.is_dir():
        raise InputError(f"--out: there is no folder {path.absolute().parent}; make it first")
    return path


class Progress:
    """One line on standard error, `label [####....] 40 %`, drawn over; nothing unless that is a terminal."""

    WIDTH, PAUSE = 30, 0.1

    def __init__(self, stream=None):
        self._stream = sys.stderr if stream is None else stream
        self._drawn = -math.inf
        self._on = self._stream.isatty()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._on and self._drawn > -math.inf:
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def __call__(self, label, done, total):
        now = time.monotonic()
        if not self._on or now - self._drawn < self.PAUSE:
            return
        self._drawn = now
        share = done / total if total else 1.0
        filled = round(self.WIDTH * share)
        self._stream.write(f"\r\x1b[K{label:<10} [{'#' * filled}{'.' * (self.WIDTH - filled)}] {share:4.0%}")
        self._stream.flush()
