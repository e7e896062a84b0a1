"""Signals: work is asked to stop, and ended if it does not."""

import signal
import subprocess
import sys
import time

import pytest

SCRIPT = """
import sys, time
from orchestrator import console
console.POLITE = 0.3
asked = []

def main(arguments):
    if "asks" in arguments:
        with console.stopping(lambda: asked.append(1)):
            print("ready", flush=True)
            while not (asked and "obeys" in arguments):
                time.sleep(0.01)
        print("stopped by itself", flush=True)
        raise KeyboardInterrupt
    print("ready", flush=True)
    time.sleep(60)

sys.exit(console.run_command(main, "", sys.argv[1:]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("arguments, says", [([], ""), (["asks"], ""), (["asks", "obeys"], "stopped by itself")])
def test_a_signal_ends_the_command_with_its_status_and_says_how_to_go_on(number, arguments, says, tmp_path):
    (tmp_path / "work.py").write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, "-m", "work", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={"PYTHONPATH": f"{tmp_path}:."},
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    begun = time.monotonic()
    process.send_signal(number)
    out, error = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert time.monotonic() - begun < 8
    assert out.strip() == says and "the same command continues: python -m work" in error
