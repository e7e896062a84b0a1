"""What the command lines share: help, one-line errors, exit statuses, signals."""

import os
import shlex
import signal
import sys
import threading

from motion.errors import InputError

GRACE = 8.0  # seconds that leaving may take after a signal

_caught = []  # numbers of the signals so far


def catch_signals():
    """On SIGINT and SIGTERM raise KeyboardInterrupt in the main thread; a second one, or GRACE seconds, end it all.

    To be called again after ray.init, which takes SIGTERM for itself. It must be KeyboardInterrupt: Ray's compiled code
    passes on no other exception of a signal handler.
    """

    def handler(number, frame):
        _caught.append(number)
        if len(_caught) > 1:
            os._exit(128 + number)
        timer = threading.Timer(GRACE, os._exit, [128 + number])
        timer.daemon = True
        timer.start()
        raise KeyboardInterrupt

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
        print(f"stopped; the same command continues: {command}", file=sys.stderr)
        return 128 + (_caught[0] if _caught else signal.SIGINT)
