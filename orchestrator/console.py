"""What the command lines share: help, one-line errors, exit statuses, signals."""

import os
import shlex
import signal
import sys
import threading

from motion.errors import InputError

GRACE = 8.0  # seconds that leaving may take after a signal


class Stopped(BaseException):
    """A signal asked to leave. Not an Exception, so that nobody takes it for a failure."""

    def __init__(self, number):
        self.number = number


def catch_signals():
    """Raise `Stopped` in the main thread on SIGINT and SIGTERM; a second one, or GRACE seconds, end the process.

    To be called again after ray.init, which takes SIGTERM for itself.
    """

    def handler(number, frame):
        catch_signals_hard()
        timer = threading.Timer(GRACE, os._exit, [128 + number])
        timer.daemon = True
        timer.start()
        raise Stopped(number)

    signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


def catch_signals_hard():
    """From now on a signal ends the process at once."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, frame: os._exit(128 + n))


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
    except Stopped as stop:
        command = shlex.join(["python", "-m", sys.modules["__main__"].__spec__.name, *arguments])
        print(f"stopped; the same command continues: {command}", file=sys.stderr)
        return 128 + stop.number

