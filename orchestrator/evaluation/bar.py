"""Progress of an evaluation: a bar in place with the time left, or plain lines where there is no terminal."""

import shutil
import sys
import time

from orchestrator.progress import duration, samples

WIDTH = 24  # characters of the bar
LINE_EVERY = 10.0  # seconds between plain lines
BELIEVED = 2.0  # seconds of work before its rate is believed


class Bar:
    """One line of progress. Use as a context manager."""

    def __init__(self, total, done=0, stream=None, interactive=None, clock=time.monotonic):
        """total: tasks in all. done: those that were finished before."""
        self._total, self._before, self._done, self._steps = total, done, done, 0
        self._stream = stream or sys.stdout
        self._interactive = self._stream.isatty() if interactive is None else interactive
        self._clock = clock
        self._start = self._shown = clock()
        self._open = False

    def __enter__(self):
        self._write(self.line())
        return self

    def __exit__(self, *_):
        if self._open:
            self._put("\n")

    def advance(self, tasks, steps=0):
        """So many tasks more are finished, which took so many policy steps."""
        self._done += tasks
        self._steps += steps
        if self._interactive or self._done >= self._total or self._clock() - self._shown >= LINE_EVERY:
            self._write(self.line())

    def say(self, text):
        """Another phase, of which nobody knows how long it takes."""
        if self._interactive or self._clock() - self._shown >= LINE_EVERY:
            self._write(text)

    def line(self):
        """The line's text."""
        share = self._done / self._total if self._total else 1.0
        bar = "#" * int(WIDTH * share) + "-" * (WIDTH - int(WIDTH * share))
        parts = [f"evaluating [{bar}] {share:4.0%}", f"{self._done:,}/{self._total:,} tasks"]
        seconds, fresh = self._clock() - self._start, self._done - self._before
        if fresh and seconds >= BELIEVED:
            if self._steps:
                parts.append(f"{samples(self._steps / seconds)} steps/s")
            if self._done < self._total:
                parts.append(f"{duration((self._total - self._done) * seconds / fresh)} left")
        return "  ".join(parts)

    def _write(self, text):
        self._shown = self._clock()
        if self._interactive:
            self._put("\r\x1b[K" + text[: shutil.get_terminal_size().columns - 1])
            self._open = True
        else:
            self._put(text + "\n")

    def _put(self, text):
        try:
            self._stream.write(text)
            self._stream.flush()
        except (BrokenPipeError, ValueError):
            pass  # nobody reads any more; the evaluation goes on
