"""The base of every contract (frozen, closed to unknown fields, finite numbers only) and the bounds that fields share.

Every string, list, dict and number of a contract is bounded; a test walks all of them. A bound that has no natural
value is wide enough for what lightkiln makes and small enough for a row of the database.
"""

import json
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

FLOAT32_MAX: Final = 3.4028234663852886e38

Id = Annotated[str, Field(max_length=64)]
"""What the coordinator calls a job, a task or a worker."""
Word = Annotated[str, Field(max_length=64)]
"""A short name out of a list: a unit, a code, a kind of event."""
Name = Annotated[str, Field(max_length=256)]
"""A name that people or machines have given."""
Url = Annotated[str, Field(max_length=2048)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Real = Annotated[float, Field(ge=-FLOAT32_MAX, le=FLOAT32_MAX)]
"""A measured value; the range of 32-bit floats, in which all is computed."""
Magnitude = Annotated[float, Field(ge=0, le=FLOAT32_MAX)]
Seconds = Annotated[float, Field(ge=0, le=1e9)]
DETAIL_BYTES: Final = 1 << 20


def _is_small(tree: dict[str, Any]) -> dict[str, Any]:
    if len(json.dumps(tree)) > DETAIL_BYTES:
        raise ValueError(f"is more than {DETAIL_BYTES} bytes of JSON")
    return tree


Detail = Annotated[
    dict[Name, Any], Field(max_length=64, json_schema_extra={"x-maxBytes": DETAIL_BYTES}), AfterValidator(_is_small)
]
"""What else is known of an event, as JSON."""


class Contract(BaseModel):
    """A frozen model that refuses fields it does not know and numbers that are not finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
