"""Contracts made of a command line's options: what is refused is an error that names the option."""

import re
from collections.abc import Mapping
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from kiln_schemas.base import Contract
from kiln_schemas.errors import InputError
from kiln_schemas.text import told

C = TypeVar("C", bound=Contract)
KEY: Final = re.compile(r"[\x21-\x7e]([\x20-\x7e]{0,253}[\x21-\x7e])?")
"""An idempotency key: it is an HTTP header, so printable ASCII."""


def of_options(contract: type[C], options: Mapping[str, str], **values: Any) -> C:
    """The contract with these values; InputError names the option of the first field at fault (`options`, by field)."""
    try:
        return contract.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        field = str(first["loc"][0]) if first["loc"] else ""
        reason = first["msg"].removeprefix("Value error, ")
        raise InputError(
            f"'{told(str(first['input']), 80)}' is refused: {reason}", where=options.get(field, field)
        ) from None


def check_key(key: str, where: str = "Idempotency-Key") -> str:
    """The idempotency key unchanged, InputError where no header may hold it."""
    if not KEY.fullmatch(key):
        raise InputError(
            f"'{told(key, 80)}' is not a key",
            where=where,
            remedy="Use 1 to 255 printable ASCII characters, without blanks at the ends.",
        )
    return key
