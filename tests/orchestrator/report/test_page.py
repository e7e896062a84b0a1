"""The report as a whole: one page that stands alone, tells what it knows, and names what it does not."""

import base64
import html
import io
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
from PIL import Image

from motion.errors import InputError
from orchestrator import report
from orchestrator.evaluation import replay, subject
from orchestrator.report import __main__ as command
from orchestrator.report import assembly, data, films, heat
from orchestrator.report.style import sheet

VOID = {"meta", "link", "br", "img", "hr", "input"}
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Checker(HTMLParser):
    """Collects ids and references, and fails where tags do not match."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.count = [], [], [], {}

    def handle_starttag(self, tag, attributes):
        self.handle_startendtag(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.count[tag] = self.count.get(tag, 0) + 1
        for key, value in attributes:
            if key == "id":
                self.ids.append(value)
            if key in ("src", "href", "xlink:href", "action", "data", "srcset", "poster"):
                self.references.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def checked(text):
    """The `Checker` of a page that stands alone."""
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert not checker.open
    assert len(checker.ids) == len(set(checker.ids))
    assert all(value.startswith(("#", "data:")) for value in checker.references)
    assert {value[1:] for value in checker.references if value.startswith("#")} <= set(checker.ids)
    assert set(re.findall(r'\bfor="([^"]+)"', text)) <= set(checker.ids)
    assert "script" not in checker.count and "@import" not in text and not re.search(r"url\((?!#)", text)
    return checker


class Undrawn(films.Drawing):
    """Pictures at once: this test is about the page around them."""

    def _start(self):
        pass

    def wait(self):
        out = io.BytesIO()
        Image.new("RGB", (64, 48), "#334").save(out, format="WEBP")
        return dict.fromkeys(self._films, out.getvalue()), None


@pytest.fixture(scope="module")
def made(make_sweep, policy, tmp_path_factory):
    """(text of the page, its sweep) with everything in it."""
    sweep = make_sweep(tmp_path_factory.mktemp("report"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(films, "Drawing", Undrawn)
        paths = report.make(sweep.out, sweep.runs, sweep.runs[0].config)
    assert paths == [sweep.out / name for name in (report.NAME, "baselines.json", "baselines.md")]
    return paths[0].read_text(), sweep


# ----------------------------------------------------------------------------------------------------------- what is in


def test_the_page_stands_alone_and_holds_every_part(made):
    text, _ = made
    checker = checked(text)
    assert "What is missing" not in text, re.findall(r"<h2>What is missing</h2>.*", text, re.S)
    for part in ("Results", "Training", "Transitions", "Videos", "Where it fails", "Against kinematic", "Environment"):
        assert f"<h2>{part}" in text
    assert checker.count["svg"] >= 7 and checker.count["img"] == 2 + 2  # a strip of two rows, two videos
    assert "a &lt;b&gt; &amp; c" in text and "<b> & c" not in text
    assert len(text) < 15e6


def test_every_colour_has_a_light_and_a_dark_value(made):
    text, _ = made
    light, dark = sheet().split("@media (prefers-color-scheme: dark)")
    used = set(re.findall(r"var\(--([\w-]+)\)", text)) - {"width", "p"}
    for theme in (light, dark):
        assert used <= set(re.findall(r"--([\w-]+): #", theme))
    assert "#0102" not in text  # placeholders are all replaced


def test_heat_maps_show_the_evaluations_shares(made):
    text, sweep = made
    found = heat.groups(data.read(sweep.out, sweep.runs).rows["ours"])
    assert sum(entry["tasks"] for entry in found) == 2 * 9 * 20  # both seeds
    assert 'title="idle → stab: 6 of 40">15</td>' in text and 'title="run → stab: 32 of 40">80</td>' in text
    assert 'title="run → stab: 0 of 40">0</td>' in text  # at the final accuracy


def test_baselines_are_kept_until_the_policy_is_evaluated_again(made, monkeypatch, tmp_path):
    out = shutil.copytree(made[1].out, tmp_path / "copy")
    path, runs = out / "baselines.json", data.find_runs(out)
    content = json.loads(path.read_text())
    assert content["tasks"] == 2 and {"ours", "interpolation"} <= {row["method"] for row in content["methods"]}
    path.write_text(json.dumps({**content, "tasks": 77}))
    monkeypatch.setattr(assembly, "Show", lambda *_: pytest.fail("asked for no films"))
    config = runs[0].config
    config.report.strips = config.report.videos = 0
    report.make(out, runs, config)
    assert "of the 77 tasks" in (out / report.NAME).read_text()
    later = path.stat().st_mtime + 5
    os.utime(runs[0].folder / "evaluation.json", (later, later))
    report.make(out, runs, config)
    assert json.loads(path.read_text()) == content


# ------------------------------------------------------------------------------------------------------ what is missing


def missing(text):
    """The lines below `What is missing`."""
    return [html.unescape(line) for line in re.findall(r"<li>(.*?)</li>", text.split("What is missing</h2>")[1])]


def test_a_sweep_that_has_not_ended_has_a_page_that_says_what_it_lacks(make_sweep, tmp_path):
    sweep = make_sweep(tmp_path, rows=("ours",), seeds=(0,), evaluated=False)
    (sweep.runs[0].folder / "metrics.jsonl").unlink()
    (path,) = report.make(sweep.out, sweep.runs, sweep.runs[0].config)
    checked(path.read_text())
    lines = missing(path.read_text())
    assert len(lines) == 2 and "no curve" in lines[0] and "not evaluated: python -m orchestrator.evaluate" in lines[1]


def test_parts_that_fail_are_one_line_each_and_leave_the_others(make_sweep, monkeypatch, tmp_path):
    """No checkpoint: neither films nor a comparison; an old evaluation: no heat map. Table and curves are there."""
    sweep = make_sweep(tmp_path, rows=("ours",), seeds=(0,))
    path = sweep.runs[0].folder / "evaluation.json"
    content = json.loads(path.read_text())
    newer = ("groups", "by_rotation", "by_accuracy")
    path.write_text(json.dumps({key: value for key, value in content.items() if key not in newer}))
    monkeypatch.setattr(replay, "load_policy", subject.load_newest)
    monkeypatch.setattr(assembly, "draw_curves", lambda sweep: 1 / 0)
    (page,) = report.make(sweep.out, sweep.runs, sweep.runs[0].config)
    lines = missing(page.read_text())
    checked(page.read_text())
    assert [line.partition(":")[0] for line in lines] == [
        "films", "comparison with kinematic transitions", "ours-seed0", "no comparison with kinematic transitions",
        "curves",
    ]  # fmt: skip
    assert "holds no checkpoint" in lines[0] and "older version" in lines[2] and "ZeroDivisionError" in lines[4]
    assert "<h2>Results" in page.read_text()


def test_without_opengl_strips_are_stick_figures_and_a_line_says_how_to_get_rendered_ones(
    make_sweep, policy, monkeypatch, tmp_path
):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    sweep = make_sweep(tmp_path, rows=("ours",), seeds=(0,))
    config = sweep.runs[0].config
    config.report.tasks = 0
    (path,) = report.make(sweep.out, sweep.runs, config)
    text = path.read_text()
    lines = [line for line in missing(text) if line.startswith("films")]
    assert len(lines) == 1 and "libegl1" in lines[0] and "nonsense" in lines[0]
    assert checked(text).count.get("img", 0) == 0 and text.count('aria-label="Film strip') == 2


# ----------------------------------------------------------------------------------------------------- command, browser


def test_the_command_writes_the_page_and_its_figures(make_sweep, policy, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(films, "Drawing", Undrawn)
    sweep, folder = make_sweep(tmp_path, seeds=(0,)), tmp_path / "figures"
    assert command.main([str(sweep.out), "report.tasks=0", f"report.figures={folder}", "report.strips=2"]) == 0
    output = capsys.readouterr().out
    names = {path.name for path in folder.iterdir()}
    curves = {"return-samples.svg", "reductions-minutes.svg", "rotation.svg", "accuracy.svg"}
    assert curves | {"strip1-ours.webp", "worst0.webp"} <= names
    assert str(sweep.out / "report.html") in output and str(folder / "rotation.svg") in output
    for path in folder.glob("*.svg"):
        text = path.read_text()
        assert "var(" not in text and "No SBC" in text
        checked(text)
    config = data.find_runs(sweep.out)[0].config
    assert config.report.figures is None  # the runs' own configuration stays as it was


@pytest.mark.parametrize(
    ("arguments", "words"),
    [([], "no sweep folder"), (["nowhere"], "nowhere: is not a folder"), (["."], "holds no run"),
     ([".", "seed=3"], "only takes report.*")],
)  # fmt: skip
def test_bad_input_is_one_clear_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        command.main(arguments)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_browser_shows_the_page_on_a_phone_without_complaint(made, tmp_path, scheme):
    """390 pixels wide: nothing is wider than the page, every picture loads, nothing is said on the console."""
    text, _ = made
    # the page in a frame of a phone's width; the frame's script asks the page, which has none itself
    wrapper = f"""<!doctype html><link rel="icon" href="data:,"><iframe id="page" style="width:390px;height:800px"
srcdoc="{html.escape(text)}"></iframe><pre id="out"></pre><script>
page.onload = async () => {{ const d = page.contentDocument, images = [...d.images];
  await Promise.all(images.map(image => image.decode()));
  out.textContent = JSON.stringify({{wide: d.documentElement.scrollWidth,
    images: images.map(image => image.naturalWidth), background: getComputedStyle(d.body).backgroundColor,
    panels: [...d.querySelectorAll(".panel")].filter(p => p.offsetHeight > 0).length}}); }};</script>"""
    path = tmp_path / "phone.html"
    path.write_text(wrapper)
    result = subprocess.run(
        [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}",
         f"--blink-settings=preferredColorScheme={int(scheme == 'light')}", "--enable-logging=stderr",
         "--virtual-time-budget=20000", "--dump-dom", path.as_uri()],
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    found = json.loads(html.unescape(re.search(r'<pre id="out">(.*?)</pre>', result.stdout, re.S)[1]))
    assert found["wide"] <= 390
    assert len(found["images"]) == 4 and min(found["images"]) > 0
    assert found["background"] == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 24, 28)"}[scheme]
    assert found["panels"] == 2  # of either tabs one
    assert "CONSOLE" not in result.stderr, [line for line in result.stderr.splitlines() if "CONSOLE" in line]


def test_pictures_of_the_page_are_webp(made):
    text, _ = made
    for encoded in re.findall(r'src="data:image/webp;base64,([^"]+)"', text):
        assert Image.open(io.BytesIO(base64.b64decode(encoded))).format == "WEBP"
