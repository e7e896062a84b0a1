"""Heat maps as HTML tables: the numbers can be read, copied and heard."""

from html import escape


def groups(runs):
    """[{source, target, tasks, reached, reached_trained}] summed over a row's runs, names instead of numbers.

    [] if none of them has an evaluation by groups.
    """
    sums = {}
    for run in runs:
        if not run.evaluation or "groups" not in run.evaluation:
            continue
        names = run.evaluation["states"]
        for entry in run.evaluation["groups"]:
            pair = names[entry["source"]], names[entry["target"]]
            counts = sums.setdefault(pair, {"tasks": 0, "reached": 0, "reached_trained": 0})
            for key in counts:
                counts[key] += entry[key]
    return [{"source": source, "target": target, **counts} for (source, target), counts in sums.items()]


def turns(runs):
    """by_rotation of evaluation.json, summed over a row's runs; [] if none of them has it."""
    sums = {}
    for run in runs:
        for entry in (run.evaluation or {}).get("by_rotation", ()):
            total = sums.setdefault((entry["low"], entry["high"]), dict.fromkeys(("tasks", "reached_trained"), 0))
            for key in total:
                total[key] += entry[key]
    return [{"low": low, "high": high, **total} for (low, high), total in sums.items()]


def accuracies(runs):
    """[(cuts of the thresholds, share of all tasks reached there)] over a row's runs; [] if none of them has it."""
    reached, tasks = {}, 0
    for run in runs:
        if run.evaluation and "by_accuracy" in run.evaluation:
            tasks += run.evaluation["tasks"]
            for entry in run.evaluation["by_accuracy"]:
                reached[entry["tightenings"]] = reached.get(entry["tightenings"], 0) + entry["reached"]
    return [(cuts, count / tasks) for cuts, count in reached.items()]


def matrix(title, found, key):
    """Source x target of `groups`. key: reached or reached_trained."""
    names = list(dict.fromkeys(entry["source"] for entry in found))
    names += [name for name in dict.fromkeys(entry["target"] for entry in found) if name not in names]
    entries = {(entry["source"], entry["target"]): entry for entry in found}
    head = "".join(f'<th scope="col">{clip(name)}</th>' for name in names)
    body = []
    for source in names:
        cells = "".join(
            cell(entries.get((source, target)), key, f"{clip(source)} → {clip(target)}") for target in names
        )
        body.append(f'<tr><th scope="row">{clip(source)}</th>{cells}</tr>')
    tasks, reached = (sum(entry[name] for entry in found) for name in ("tasks", key))
    share = f"{100 * reached / tasks:.0f} % of {tasks:,} tasks" if tasks else "no tasks"
    return (
        f'<div class="heat scroll" tabindex="0"><table><caption>{escape(title)}: {share}</caption>'
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def moments(title, runs):
    """Share reached by source and moment, summed over a row's runs; empty if no evaluation has it."""
    sums = {}
    for run in runs:
        for entry in (run.evaluation or {}).get("by_moment", ()):
            source = run.evaluation["states"][entry["source"]]
            counts = sums.setdefault((source, entry["low"], entry["high"]), {"tasks": 0, "reached_trained": 0})
            for key in counts:
                counts[key] += entry[key]
    if not sums:
        return ""
    rows = {}
    for (source, low, high), counts in sums.items():
        rows.setdefault(source, []).append(cell(counts, "reached_trained", f"{low:.2f} to {high:.2f} s"))
    body = "".join(f'<tr><th scope="row">{clip(source)}</th>{"".join(cells)}</tr>' for source, cells in rows.items())
    return (
        f'<div class="heat scroll" tabindex="0"><table><caption>{escape(title)}: by the moment in the source clip'
        f"</caption><tbody>{body}</tbody></table></div>"
    )


def cell(entry, key, words):
    """One share in percent."""
    if not entry or not entry["tasks"]:
        return f'<td class="none" title="{words}: no task">·</td>'
    share = 100 * entry[key] / entry["tasks"]
    kind = ' class="high"' if share > 55 else ""
    return f'<td{kind} style="--p:{share:.0f}%" title="{words}: {entry[key]} of {entry["tasks"]}">{share:.0f}</td>'


def clip(name):
    return escape(name.replace("_", " "))
