"""What a process and all its descendants use, from /proc."""

import os
from pathlib import Path

_TICK = os.sysconf("SC_CLK_TCK")


def tree(root):
    """Process ids of `root` and all its descendants that are alive."""
    children = {}
    for entry in Path("/proc").glob("[0-9]*"):
        fields = _stat(entry.name)
        if fields:
            children.setdefault(int(fields[1]), []).append(int(entry.name))
    found, stack = [], [root]
    while stack:
        pid = stack.pop()
        found.append(pid)
        stack += children.get(pid, [])
    return found


class CPU:
    """CPU seconds that a process and all its descendants have used.

    What has ended keeps what it was last seen with: the kernel adds that to the parent only if the parent waits for it.
    """

    def __init__(self, root):
        self._root, self._used = root, {}

    def seconds(self):
        """CPU seconds so far; call it often, as what a process uses between the last call and its end is not seen."""
        for pid in tree(self._root):
            fields = _stat(pid)
            if fields:
                self._used[pid, fields[19]] = (int(fields[11]) + int(fields[12])) / _TICK  # start time; utime, stime
        return sum(self._used.values())


def memory(pids):
    """MB (proportional set size: shared pages counted once) of processes."""
    total = 0
    for pid in pids:
        try:
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


def _stat(pid):
    """The fields of /proc/PID/stat after the name (the first is the state), or None if the process is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
