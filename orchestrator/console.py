"""What the command lines share: help, one-line errors, exit statuses, signals."""

import contextlib
import os
import shlex
import signal
import sys
import threading

from motion.errors import InputError

POLITE = 4.0  # seconds that work asked to stop has for it
GRACE = 7.0  # seconds that leaving may take in all after a signal

_caught = []  # numbers of the signals so far
_asked = []  # functions that ask running work to stop


@contextlib.contextmanager
def stopping(ask):
    """Within this context the first signal calls `ask()`, which is to make the work end soon, instead of ending it."""
    _asked.append(ask)
    try:
        yield
    finally:
        _asked.remove(ask)
        signal.setitimer(signal.ITIMER_REAL, 0)


def catch_signals():
    """On SIGINT and SIGTERM ask the work to stop, or, where none is under way, raise KeyboardInterrupt.

    It is raised, too, where the work does not stop within POLITE seconds; a second signal, or GRACE seconds, end it
    all. To be called again after ray.init, which takes SIGTERM for itself. It must be KeyboardInterrupt: Ray's compiled
    code passes on no other exception of a signal handler.
    """

    def interrupt(number, frame):
        raise KeyboardInterrupt

    def handler(number, frame):
        _caught.append(number)
        if len(_caught) > 1:
            os._exit(128 + number)
        timer = threading.Timer(GRACE, os._exit, [128 + number])
        timer.daemon = True
        timer.start()
        if not _asked:
            raise KeyboardInterrupt
        for ask in _asked:
            ask()
        signal.signal(signal.SIGALRM, interrupt)
        signal.setitimer(signal.ITIMER_REAL, POLITE)

    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


def run_command(main, doc, arguments):
    """Exit status of a command: main(arguments)'s, 0 for --help, 2 for bad input, 130 or 143 after a signal."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(doc.strip())
        return 0
    catch_signals()
    try:
        return main(arguments)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        command = shlex.join(["python", "-m", sys.modules["__main__"].__spec__.name, *arguments])
        print(f"stopped; the same command continues: {command}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        # at once: while Python's own end waits for libraries, the timer's thread no longer runs
        os._exit(128 + (_caught[0] if _caught else signal.SIGINT))
