"""Text without secrets: what goes into defect logs, which users are asked to send in, and into tasks' logs.

Removed are values that this process knows to be secret (variables of the environment whose names say so, and the
values of options that take a secret) wherever they occur, and what has the form of a secret: bearer tokens, and
passwords in URLs and in connection strings.
"""

import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

HIDDEN: Final = "[removed]"
LEAST: Final = 6
"""A shorter value is no secret, and its removal would spoil other words."""
SECRET_NAMES: Final = re.compile(
    r"TOKEN|SECRET|PASSWORD|PASSWD|CREDENTIAL|_KEY(?:_|$)|DATABASE|DSN|(?<!NO_)PROXY", re.IGNORECASE
)
SECRET_OPTIONS: Final = frozenset({"--token", "--database"})
SHAPES: Final = (
    re.compile(r"(?<=Bearer )\S+", re.IGNORECASE),
    re.compile(r"(?<=://)[^\s/@'\"]+(?=@)"),
    re.compile(r"(?<=password=)(?:'[^']*'|\S+)", re.IGNORECASE),
)


def redacted(
    text: str,
    secrets: Iterable[str] = (),
    *,
    environment: Mapping[str, str] = os.environ,
    arguments: Sequence[str] | None = None,
) -> str:
    """The text with secrets replaced; `secrets` are further ones, `arguments` are those of this process by default."""
    known = {*secrets, *_of_arguments(sys.argv if arguments is None else arguments)}
    known |= {value for name, value in environment.items() if SECRET_NAMES.search(name) and name.upper() != "NO_PROXY"}
    for secret in sorted(known, key=len, reverse=True):
        if len(secret) >= LEAST:
            text = text.replace(secret, HIDDEN)
    for shape in SHAPES:
        text = shape.sub(HIDDEN, text)
    return text


def command_of(arguments: Sequence[str]) -> str:
    """The words of a command line that say what was asked: program, command and names of options, no values."""
    words = []
    for word in arguments:
        if word.startswith("-") and word != "-":
            words.append(word.partition("=")[0])
        elif len(words) < 3 and re.fullmatch(r"[a-z]+", word):
            words.append(word)
    return " ".join(words)


def _of_arguments(arguments: Sequence[str]) -> Iterable[str]:
    for index, word in enumerate(arguments):
        option, equals, value = word.partition("=")
        if option in SECRET_OPTIONS:
            yield value if equals else "".join(arguments[index + 1 : index + 2])
