"""Random numbers as counters: every number is a hash of what it is for, never of when or where it is drawn.

The generator is SplitMix64 (Steele, Lea and Flood 2014, "Fast Splittable Pseudorandom Number Generators"): a state that
advances by a constant and a mixing function. A lane's state is hashed from the scene, the texel, the stream and the
element (pixel or block) that it computes, a path's from the lane's and the sample's number, so that any
split of the work into wavefronts gives the same bytes. The first two dimensions of a sample come from the R2 sequence
(Roberts 2018), shifted by a random offset per element (Cranley and Patterson 1976), in exact 32-bit integers.
"""

from typing import Any, Final

from kiln_workers.render.jit import mi

GAMMA: Final = 0x9E3779B97F4A7C15
_MIX_1: Final = 0xBF58476D1CE4E5B9
_MIX_2: Final = 0x94D049BB133111EB

# 2^32 / g and 2^32 / g^2 with g = 1.32471795724474602596, the root of g^3 = g + 1.
_R2_X: Final = 3242174889
_R2_Y: Final = 2447445414

STREAM_LIGHT_FIELD: Final = 1
STREAM_IRRADIANCE: Final = 2
STREAM_DIRECT: Final = 3
STREAM_VISIBILITY: Final = 4


def mix(z: Any) -> Any:
    """SplitMix64's finaliser of UInt64 (Dr.Jit, or Python integers masked by the caller's type)."""
    z = (z ^ (z >> 30)) * _MIX_1
    z = (z ^ (z >> 27)) * _MIX_2
    return z ^ (z >> 31)


def lane_state(scene_key: int, stream: int, texel: Any, element: Any) -> Any:
    """State of the lane that computes `element` of `texel` (Dr.Jit UInt64 each)."""
    state = mix(mi.UInt64(texel) * GAMMA + mi.UInt64(scene_key))
    return mix(state + mi.UInt64(element) * GAMMA + stream)


def sample_state(lane: Any, sample: Any) -> Any:
    """State of sample number `sample` of a lane."""
    return mix(lane + (mi.UInt64(sample) + 1) * GAMMA)


def pair(state: Any) -> tuple[Any, Any]:
    """The next state and two independent uniform numbers in [0, 1) with 24 bits each, as a Point2f."""
    state = state + GAMMA
    bits = mix(state)
    return state, mi.Point2f(_unit(mi.UInt32(bits >> 32)), _unit(mi.UInt32(bits)))


def stratified_pair(lane: Any, sample: Any) -> Any:
    """Point `sample` of the R2 sequence, shifted by the lane's own offset, as a Point2f in [0, 1)^2."""
    shift = mix(lane)
    x = mi.UInt32(shift >> 32) + mi.UInt32(sample) * _R2_X
    y = mi.UInt32(shift) + mi.UInt32(sample) * _R2_Y
    return mi.Point2f(_unit(x), _unit(y))


def _unit(bits: Any) -> Any:
    return mi.Float(bits >> 8) * (1.0 / (1 << 24))
