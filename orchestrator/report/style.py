"""The report's style sheet: `motion.page.style` and what only this page has."""

from motion.page import style
from orchestrator.report.charts import DARK, LIGHT
from orchestrator.report.curves import AXES
from orchestrator.table.html_page import STYLE as TABLE

ACCURACIES = ("trained", "final")  # tabs of the heat maps

OWN = """
img { display: block; max-width: none; border-radius: 6px; }
code { font-size: .85em; overflow-wrap: anywhere; }
.results { margin: .6em 0 1.2em; }
.results, .wide { background: var(--panel); border-radius: 6px; padding: .4rem; }
.results th:first-child { background: var(--panel); }
.results table, .heat table { font-size: .82rem; }
.results th, .results td { padding: .2rem .5rem; }
.tabs > input { position: absolute; opacity: 0; }
.tabs > label { display: inline-block; padding: .15rem .7rem; margin: .3rem .3rem .3rem 0; border-radius: 1rem;
  border: 1px solid var(--grid); cursor: pointer; font-size: .85rem; }
.tabs > input:checked + label { background: var(--ink); color: var(--paper); }
.tabs > input:focus-visible + label { outline: 2px solid var(--row0); }
.tabs > .panel { display: none; }
.line { display: inline-block; width: 1.9em; height: .75em; vertical-align: baseline; margin-right: .35em; }
.heat { width: fit-content; max-width: 100%; }
.heat td, .heat th { border: none; padding: 0; text-align: center; font-weight: 400; }
.heat td { width: 2.1rem; min-width: 2.1rem; height: 1.7rem; border: 1px solid var(--panel);
  background: color-mix(in srgb, var(--heat) var(--p), var(--cold)); }
.heat td.high { color: var(--on-heat); }
.heat td.none { background: none; color: var(--faint); }
.heat th { color: var(--faint); }
.heat tbody th { text-align: right; padding-right: .5em; white-space: nowrap; position: sticky; left: 0;
  background: var(--panel); }
.heat thead th { writing-mode: vertical-rl; rotate: 180deg; padding: .3em 0; white-space: nowrap; }
.heat thead th:first-child, .heat caption { writing-mode: horizontal-tb; rotate: none; }
.heat caption { text-align: left; padding-bottom: .3em; font-size: .9rem; }
.strip { margin: .3rem 0 .7rem; }
.strip .scroll { padding: 0; }
.strip svg { background: var(--panel); width: 100%; max-width: none; }
.times { display: grid; grid-auto-flow: column; grid-auto-columns: 1fr; color: var(--faint); font-size: .7rem;
  text-align: center; }
.strip figcaption, .video figcaption { color: var(--ink); }
.videos + h3 { margin-top: 1.5rem; }
.videos { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; }
.video { margin: 0; max-width: 100%; }
.video img { width: 100%; height: auto; }
.pair span { display: inline-block; width: 50%; text-align: center; font-size: .8rem; color: var(--faint); }
.bars { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 19rem), 1fr)); gap: .4rem 1.6rem; }
.bars table { width: 100%; font-size: .8rem; }
.bars td { border: none; padding: .1rem .3rem; }
.bars td:nth-child(2) { width: 45%; }
.bars td:first-child { white-space: normal; }
.bars small { color: var(--faint); }
.bars h3 { margin-bottom: 0; }
.bar { height: .75em; border-radius: 2px; background: var(--row5); width: var(--p); min-width: 1px; }
.bar.ours { background: var(--transition); }
.bar.clips { background: var(--faint); }
ul { padding-left: 1.2rem; max-width: 46rem; }
"""
LIGHT_OWN = "--source: #4587db; --transition: #e8801f; --heat: #0b5fa5; --cold: #e9edf2; --on-heat: #ffffff;"
DARK_OWN = "--source: #5f9df0; --transition: #f59335; --heat: #6db6ff; --cold: #262d35; --on-heat: #0d1217;"


def sheet():
    """The whole style sheet (text)."""
    rows = [" ".join(f"--row{i}: {colour};" for i, colour in enumerate(colours)) for colours in (LIGHT, DARK)]
    tabs = (("axis", AXES, "grid"), ("heat", ACCURACIES, "block"))
    shown = [f"#{k}-{name}:checked ~ .{name} {{ display: {how}; }}\n" for k, names, how in tabs for name in names]
    return style(f"{LIGHT_OWN}\n  {rows[0]}", f"{DARK_OWN}\n  {rows[1]}", TABLE + OWN + "".join(shown))
