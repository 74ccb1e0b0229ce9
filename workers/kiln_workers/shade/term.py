"""The parts of a picture's light."""

from enum import StrEnum
from typing import Final


class Term(StrEnum):
    """A part of a picture; the default picture is the sum of WHOLE."""

    EMISSION = "emission"
    """What surfaces emit themselves."""
    DIFFUSE = "diffuse"
    """The irradiance map on what is not metal."""
    INTERREFLECTION = "interreflection"
    """Glossy reflection of the scene: the light field."""
    ENVIRONMENT = "environment"
    """Glossy reflection of the environment: U W_E (eq. 8)."""
    UNOCCLUDED = "unoccluded"
    """The same without visibility: U alone (eq. 4), for comparison."""
    MIRROR_VISIBILITY = "mirror-visibility"
    """U where the specular ray leaves the scene (the paper's figure 4, which leaks), for comparison."""
    BACKGROUND = "background"
    """The environment where no surface is."""


COMPARED: Final = (Term.UNOCCLUDED, Term.MIRROR_VISIBILITY)
"""What may stand in the place of ENVIRONMENT, to see what W_E does."""

WHOLE: Final = tuple(term for term in Term if term not in COMPARED)
