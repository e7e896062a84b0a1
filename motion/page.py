"""A page of HTML that stands alone: no link to anything outside, readable on a phone, in light and dark."""

import html

STYLE = """
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 68rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .3rem; padding-top: .8rem; border-top: 1px solid var(--grid); }
h3 { font-size: 1rem; margin: 1.2rem 0 .2rem; }
p { margin: .4rem 0; max-width: 46rem; }
figure { margin: .8rem 0; }
figcaption { color: var(--faint); font-size: .85rem; max-width: 46rem; }
svg { display: block; width: 100%; max-width: var(--width); height: auto; }
.side { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 0 1.5rem; }
figure, .scroll { max-width: 100%; min-width: 0; }
.scroll { overflow-x: auto; width: fit-content; background: var(--panel); border-radius: 6px; padding: .4rem; }
.scroll svg { width: var(--width); max-width: none; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid var(--grid); white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; white-space: normal; }
@media (max-width: 34rem) { table { font-size: .8rem; } th, td { padding: .2rem .3rem; } }
th:first-child, td:first-child { text-align: left; }
.keys span { white-space: nowrap; margin-right: .9em; }
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin-right: .35em; }
"""
# the variables of `motion.picture.COMMON`, and --panel, the background of boxes
LIGHT = "--ink: #1d2329; --faint: #7b858f; --grid: #e1e5e9; --paper: #ffffff; --panel: #f6f7f9;"
DARK = "--ink: #e4e8ec; --faint: #8c97a3; --grid: #2c343c; --paper: #14181c; --panel: #1b2026;"


def style(light, dark, own=""):
    """The style sheet. light, dark: values of the page's own colour variables in each theme; own: further rules."""
    return (
        f"\n:root {{ color-scheme: light dark;\n  {LIGHT}\n  {light} }}\n"
        f"@media (prefers-color-scheme: dark) {{ :root {{\n  {DARK}\n  {dark} }} }}{STYLE}{own}"
    )


def document(title, sheet, sections):
    """The whole page (text). title: plain text; sheet: of `style`; sections: HTML."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<link rel="icon" href="data:,">\n<title>{html.escape(title)}</title>\n<style>{sheet}</style>\n'
        "</head>\n<body>\n" + "\n".join(sections) + "\n</body>\n</html>\n"
    )


def data_table(head, rows):
    """A table that scrolls in its own box; head, rows: HTML of the cells."""
    line = "".join(f"<th>{text}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{line}</tr></thead><tbody>{body}</tbody></table></div>'


def figure(content, caption="", scroll=False):
    """Content with a caption (HTML both); scroll: in a box of its own, if it is wider than the page."""
    inner = f'<div class="scroll" tabindex="0">{content}</div>' if scroll else content
    return f"<figure>{inner}{f'<figcaption>{caption}</figcaption>' if caption else ''}</figure>"
