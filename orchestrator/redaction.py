"""Secrets stay out of what is printed, stored or logged: passwords in addresses, and those of the environment."""

import os
import re
from urllib.parse import unquote

# Variables whose values are secrets, by the end of their names: MLFLOW_TRACKING_PASSWORD, AWS_SECRET_ACCESS_KEY, ...
SECRET_NAMES = re.compile(r"(PASSWORD|PASSWD|TOKEN|SECRET|SECRET_ACCESS_KEY|SECRET_KEY|API_KEY|CREDENTIALS)$")
# As an URL's or a database address's query has them: ?password=...&sslpassword=...
QUERY = re.compile(r"([?&;][^=&;\s]*(?:password|passwd|token|secret|key|credential|signature)[^=&;\s]*=)[^&;\s]+", re.I)
# Up to the last @ before white space or a quote, since people leave @ and / in passwords as they are
USER = re.compile(r"(://)([^\s'\"]*)@")
SHORTEST = 4  # characters: a shorter value of a variable would strike out innocent text


def without_password(uri):
    """The address to show and to store: a password in it becomes ***, and so does a user part that has no password.

    (A lone user part may be a token.) Text without an address stays as it is.
    """
    return QUERY.sub(r"\1***", USER.sub(_masked, uri))


def _masked(match):
    name, colon, _ = match[2].partition(":")
    return f"{match[1]}{name}:***@" if colon else f"{match[1]}***@"


def redact(text, uri=""):
    """`text` without the passwords of its addresses, of `uri` and of the environment's secret variables."""
    secrets = [value for name, value in os.environ.items() if SECRET_NAMES.search(name) and len(value) >= SHORTEST]
    for user in USER.finditer(uri or ""):
        password = user[2].partition(":")[2]
        secrets += [password, unquote(password)]
    text = without_password(text)
    for secret in sorted(filter(None, secrets), key=len, reverse=True):
        text = text.replace(secret, "***")
    return text
