"""The 13 columns of the paper's Table 1, how they are written, and the paper's own numbers."""

COLUMNS = ("FRPD", "FRVD", "FRRD", "FKPD", "FJRD", "FJAD", "SURI", "TC", "TS", "MS", "TTAR", "IRFA", "Return")
FORMATS = {"TC": ".2f", "TS": ".2f", "TTAR": ".3f", "IRFA": ".0f"}  # the others: .4f
HIGHER = ("SURI", "MS", "TTAR", "Return")  # is better; of the others, lower is
MEANINGS = {
    "FRPD": "final root position deviation, m",
    "FRVD": "final root velocity deviation, m/s",
    "FRRD": "final root rotation deviation, rad",
    "FKPD": "final deviation of six key bodies' positions together, m",
    "FJRD": "final joint rotation deviation, rad",
    "FJAD": "final joint angular velocity deviation, rad/s",
    "SURI": "scaled upper body joints' rotation improvement",
    "TC": "tremble count at the end",
    "TS": "steps of 1/30 s",
    "MS": "largest noise (standard deviation, rad) at which every task is reached; x: none",
    "TTAR": "share of tasks that are reached",
    "IRFA": "iterations to the final accuracy; -: not reached",
    "Return": "accumulated reward",
}

METHODS = {"ours": "Ours", "no_sbc": "No SBC", "no_urp": "No URP", "no_tr": "No TR"}
REFERENCE = "ours"  # the row that the others are compared with
PAPER_SAMPLES = 4_000_000_000
PAPER_TASKS = 460_278

# Table 1 of the paper, MS as log sigma. The scan reads 7190 for the first TC.
PAPER = {
    "ours": (0.0038, 0.6556, 0.1677, 0.0513, 0.1071, 3.2404, -0.1677, 71.90, 12.02, -3.7, 1.000, 10362, 5.4027),
    "no_sbc": (0.0306, 0.6741, 0.2080, 0.1585, 0.1484, 2.5384, -0.1685, 76.15, 12.99, None, 0.889, 14809, 4.5615),
    "no_urp": (0.0237, 0.6906, 0.1699, 0.0903, 0.1284, 3.3104, -0.3873, 81.20, 14.09, None, 0.889, 13157, 4.1353),
    "no_tr": (0.0048, 0.7548, 0.1045, 0.0613, 0.0592, 1.2915, 0.0482, 154.27, 10.23, -3.3, 1.000, 3010, 2.8425),
}  # fmt: skip


def cell(column, value):
    """A value of a column as text: e^-3.7 or x for MS, a dash for what is not known."""
    if column == "MS":
        return "x" if value is None else f"e^{value:g}"
    return "-" if value is None else format(value, FORMATS.get(column, ".4f"))
