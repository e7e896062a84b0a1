"""Whom the project trusts: no code from a user's file is run, pages listen on this machine only, secrets stay out."""

import ast
import re
from pathlib import Path

import pytest

from orchestrator.redaction import redact, without_password

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("motion", "workers", "learner", "orchestrator", "benchmarks", "docs")

# calls that run code from what they read, as the last two parts of their names; with the argument that makes them safe
RUNS_CODE = {
    "pickle.load", "pickle.loads", "cloudpickle.load", "cloudpickle.loads", "dill.load", "dill.loads", "joblib.load",
    "shelve.open", "marshal.load", "marshal.loads", "yaml.load", "yaml.unsafe_load", "yaml.full_load", "eval", "exec",
    "numpy.load", "np.load", "torch.load", "os.system", "os.popen",
}  # fmt: skip
SAFE_IF = {
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "numpy.load": ("allow_pickle", False),
}
SAFE_BY_DEFAULT = ("np.load", "numpy.load")


def unsafe_calls(text):
    """(line, name) of the calls in Python source that run code from what they read."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        name = ".".join(ast.unparse(node.func).split(".")[-2:])
        given = {keyword.arg: keyword.value for keyword in node.keywords}
        if isinstance(shell := given.get("shell"), ast.Constant) and shell.value:
            found.append((node.lineno, name))
        if name not in RUNS_CODE:
            continue
        key, wanted = SAFE_IF.get(name, (None, None))
        value = given.get(key)
        if not (isinstance(value, ast.Constant) and value.value is wanted) and not (
            name in SAFE_BY_DEFAULT and value is None
        ):
            found.append((node.lineno, name))
    return found


def test_no_call_in_the_packages_runs_code_from_a_file():
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    assert len(files) > 50
    found = {str(path.relative_to(ROOT)): calls for path in files if (calls := unsafe_calls(path.read_text()))}
    assert found == {}


@pytest.mark.parametrize(
    "line",
    [
        "pickle.load(file)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=flag)",
        "yaml.load(text, Loader=yaml.Loader)",
        "subprocess.run(text, shell=True)",
        "eval(text)",
    ],
)
def test_the_search_finds_such_calls(line):
    assert unsafe_calls(line)


@pytest.mark.parametrize("line", ["torch.load(path, weights_only=True)", "np.load(path)", "yaml.safe_load(text)"])
def test_the_search_lets_safe_calls_pass(line):
    assert not unsafe_calls(line)


def test_only_restricted_unpicklers_read_pickles():
    """A class made from pickle.Unpickler says itself which names it resolves."""
    for path in (p for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and any("Unpickler" in ast.unparse(base) for base in node.bases):
                assert any(isinstance(item, ast.FunctionDef) and item.name == "find_class" for item in node.body)
            if isinstance(node, ast.Call):
                assert ast.unparse(node.func) not in ("pickle.Unpickler", "Unpickler"), path


# ------------------------------------------------------------------------------------------------------------- pages


def test_dashboards_listen_on_this_machine_by_default():
    from mlflow.cli import server
    from ray.scripts.scripts import start

    defaults = {command: {p.name: p.default for p in command.params} for command in (server, start)}
    assert defaults[server]["host"] == "127.0.0.1"
    assert defaults[start]["dashboard_host"] in ("localhost", "127.0.0.1")


def test_no_command_of_the_docs_opens_a_page_to_the_network():
    """0.0.0.0 stands only in docker/, inside containers whose ports are published on 127.0.0.1."""
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "orchestrator").glob("*.py")]:
        assert not re.search(r"host[= ]+(0\.0\.0\.0|::)", path.read_text()), path


# ----------------------------------------------------------------------------------------------------------- secrets


@pytest.mark.parametrize(
    "uri, shown",
    [
        ("http://host:5000", "http://host:5000"),
        ("sqlite:////a/b.db", "sqlite:////a/b.db"),
        ("http://user:hunter2@host:5000/x", "http://user:***@host:5000/x"),
        ("postgresql://user:hun/ter@2@host/db", "postgresql://user:***@host/db"),
        ("https://:hunter2@host", "https://:***@host"),
        ("https://hunter2@host", "https://***@host"),
        ("postgresql://host/db?user=me&password=hunter2", "postgresql://host/db?user=me&password=***"),
        ("mysql://host/db?ssl_key=hunter2&charset=utf8", "mysql://host/db?ssl_key=***&charset=utf8"),
        ("see http://a:hunter2@b, then http://c", "see http://a:***@b, then http://c"),
    ],
)
def test_addresses_are_shown_without_secrets(uri, shown):
    assert without_password(uri) == shown
    assert without_password(shown) == shown


def test_messages_are_shown_without_secrets(monkeypatch):
    for name in ("MLFLOW_TRACKING_TOKEN", "MLFLOW_TRACKING_PASSWORD", "AWS_SECRET_ACCESS_KEY", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, f"secret-of-{name}")
        assert redact(f"401: {name} is secret-of-{name}!") == f"401: {name} is ***!"
    text = "API request to http://me:p%40ss@host:1/api failed: password 'p@ss' or p%40ss is wrong"
    assert redact(text, "http://me:p%40ss@host:1") == (
        "API request to http://me:***@host:1/api failed: password '***' or *** is wrong"
    )
