"""Mitsuba's BSDFs as metallic-roughness materials.

Mitsuba's `alpha` is GGX's (or Beckmann's) width; glTF's roughness is its square root. A conductor's colour at normal
incidence is ((eta - 1)^2 + k^2) / ((eta + 1)^2 + k^2), of Mitsuba's own eta and k in RGB. A diffuse surface has no
reflectance at grazing incidence, unlike glTF's dielectric. docs/scene-input.md lists what is exact and what is not.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from kiln_schemas.text import quoted
from kiln_workers.render.jit import dr, mi
from kiln_workers.scene.geometry import Floats
from kiln_workers.scene.mitsuba_textures import LUMINANCE, Textures, Value, number, stacked
from kiln_workers.scene.mitsuba_tree import Plugin
from kiln_workers.scene.model import Image, Material

NAME_OF_A_METAL: Final = re.compile(r"[A-Za-z0-9_]{1,32}")
"""Mitsuba makes a file's name of it."""
WHITE: Final = number(1.0)


@dataclass(frozen=True, eq=False)
class Surface:
    """A material whose values may still be blended, masked and wrapped."""

    name: str
    base: Value
    metallic: Value = number(0.0)  # noqa: RUF009
    roughness: Value = WHITE
    opacity: Value = WHITE
    normal: Value | None = None
    transmission: float = 0.0
    ior: float = 1.5
    specular: float = 1.0
    clearcoat: float = 0.0
    double_sided: bool = False


class Surfaces:
    """Reads the BSDFs of a scene, each once."""

    def __init__(self, textures: Textures) -> None:
        self.textures = textures
        self.notes = textures.notes
        self.known: dict[Plugin, Surface | None] = {}
        self.made: dict[tuple[Surface, Value | None], Material] = {}

    def surface(self, plugin: Plugin) -> Surface | None:
        """The surface of a BSDF; None for `null`, which is none. InputError for a BSDF that is not read."""
        if plugin not in self.known:
            convert = _BSDFS.get(plugin.kind)
            if convert is None:
                raise plugin.fail("this BSDF is not read", f"Use one of {', '.join(_BSDFS)}.")
            self.known[plugin] = convert(self, plugin)
        return self.known[plugin]

    def material(self, surface: Surface, emission: Value | None = None) -> Material:
        """The material of a surface that emits `emission`; its images join the scene's."""
        if (surface, emission) not in self.made:
            self.made[surface, emission] = self._material(surface, emission)
        return self.made[surface, emission]

    def _material(self, surface: Surface, emission: Value | None) -> Material:
        red, green, blue = surface.base.colour
        base, lookup = surface.base.image, surface.base.lookup
        alpha = 1.0
        if surface.opacity.image is not None:
            (colours, opacity), lookup = stacked((surface.base, surface.opacity), self.notes, f"BSDF '{surface.name}'")
            red = green = blue = 1.0
            base = Image("masked", np.concatenate([colours, opacity @ _grey()], axis=2).astype(np.float32), False)
        else:
            alpha = surface.opacity.level
        rough, metallic = surface.roughness.level, surface.metallic.level
        glossy = None
        if surface.roughness.image is not None or surface.metallic.image is not None:
            pair = (surface.roughness, surface.metallic)
            grids, glossy_lookup = stacked(pair, self.notes, f"BSDF '{surface.name}'")
            levels = [grid @ _grey() for grid in grids]
            pixels = np.concatenate([np.zeros_like(levels[0]), *levels], axis=2).astype(np.float32)
            glossy = self.textures.reference(Image("roughness", pixels, False), glossy_lookup)
            rough = metallic = 1.0
        glow = emission or number(0.0)
        normal = surface.normal
        return Material(
            surface.name,
            (red, green, blue, alpha),
            self.textures.reference(base, lookup),
            metallic,
            rough,
            glossy,
            glow.colour,
            self.textures.reference(glow.image, glow.lookup),
            surface.double_sided,
            blend=surface.opacity.image is not None or alpha < 1.0,
            transmission=surface.transmission,
            ior=surface.ior,
            specular=surface.specular,
            clearcoat=surface.clearcoat,
            normal_texture=None if normal is None else self.textures.reference(normal.image, normal.lookup),
        )

    def inner(self, plugin: Plugin, most: int = 1) -> list[Surface | None]:
        """The surfaces in a BSDF, at least one and at most `most`."""
        inner = plugin.all("bsdf")
        if not 1 <= len(inner) <= most:
            raise plugin.fail(f"it holds {len(inner)} BSDFs", "Put one BSDF in it." if most == 1 else "Put two in it.")
        return [self.surface(child) for child in inner]

    def roughness(self, plugin: Plugin, default: float) -> Value:
        """glTF's roughness of a plugin's alpha; 0 where the plugin has none."""
        if not plugin.kind.startswith(("rough", "ward", "pplastic")):
            return number(0.0)
        across = [self.alpha(plugin, name, default) for name in ("alpha_u", "alpha_v") if plugin.has(name)]
        alpha = self.alpha(plugin, "alpha", default)
        if across:
            if len(across) == 1 or across[0].level != across[1].level:
                self.notes.append(f"{plugin.label}: anisotropic roughness is baked as its geometric mean.")
            alpha = number(float(np.sqrt(np.prod([value.level for value in (*across, across[-1])[:2]]))))
        if plugin.text("distribution", "beckmann") == "beckmann":
            self.notes.append(f"{plugin.label}: the Beckmann distribution is baked as GGX of the same alpha.")
        return alpha.mapped(lambda values: np.sqrt(np.clip(values, 0.0, 1.0)))

    def alpha(self, plugin: Plugin, name: str, default: float) -> Value:
        """A width of 0 or more."""
        if plugin.child(name) is not None:
            return self.textures.value(plugin, name, default)
        value = plugin.number(name, default)
        if value < 0.0:
            raise plugin.fail(f"its {name} is {value}")
        return number(value)

    def share(self, plugin: Plugin, name: str, default: float) -> Value:
        """A number from 0 to 1, or a texture."""
        if plugin.child(name) is not None:
            return self.textures.value(plugin, name, default)
        value = plugin.number(name, default)
        if not 0.0 <= value <= 1.0:
            raise plugin.fail(f"'{name}' is {value}, not between 0 and 1")
        return number(value)


def _grey() -> Floats:
    return np.asarray(LUMINANCE / LUMINANCE.sum())[:, None]


def _mitsuba_values(plugin: Plugin, kind: str, names: tuple[str, ...]) -> Any:
    """What Mitsuba's own BSDF of this kind has for the values `names`; they are numbers or names of substances."""
    properties = mi.Properties(kind)
    for name in names:
        if plugin.has(name):
            value = plugin.properties[name]
            if isinstance(value, str) and not NAME_OF_A_METAL.fullmatch(value.replace(" ", "_").replace("-", "_")):
                raise plugin.fail(f"'{name}' is {quoted(value)}, which is no substance")
            properties[name] = value if isinstance(value, str) else plugin.number(name, 1.0)
    try:
        return mi.traverse(mi.PluginManager.instance().create_object(properties))
    except RuntimeError:
        named = ", ".join(quoted(str(plugin.properties[name])) for name in names if plugin.has(name))
        raise plugin.fail(f"Mitsuba knows no {named}", "Give numbers.") from None


def _ior(plugin: Plugin) -> float:
    """The index of refraction inside over outside; at least 1, as one from within looks the same here."""
    eta = float(_mitsuba_values(plugin, "dielectric", ("int_ior", "ext_ior"))["eta"])
    if not (np.isfinite(eta) and eta > 0.0):
        raise plugin.fail(f"its index of refraction is {eta}")
    return max(eta, 1.0 / eta)


def _diffuse(surfaces: Surfaces, plugin: Plugin) -> Surface:
    if plugin.kind == "roughdiffuse":
        surfaces.notes.append(f"{plugin.label}: baked as diffuse.")
    return Surface(plugin.kind, surfaces.textures.value(plugin, "reflectance", 0.5), specular=0.0)


def _conductor(surfaces: Surfaces, plugin: Plugin) -> Surface:
    if plugin.text("material", "none") == "none" or plugin.has("eta"):
        eta, k = (_index(surfaces, plugin, name, default) for name, default in (("eta", 0.0), ("k", 1.0)))
    else:
        found = _mitsuba_values(plugin, "conductor", ("material",))
        eta, k = (np.array(found[f"{name}.value"], dtype=np.float64).reshape(-1) for name in ("eta", "k"))
    facing = ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)
    base = surfaces.textures.value(plugin, "specular_reflectance", 1.0)
    red, green, blue = (float(x) for x in facing * base.colour)
    return Surface(
        plugin.kind,
        replace(base, colour=(red, green, blue)),
        number(1.0),
        surfaces.roughness(plugin, 0.1),
    )


def _index(surfaces: Surfaces, plugin: Plugin, name: str, default: float) -> Floats:
    texture = plugin.child(name)
    if texture is None:
        return np.array(plugin.unbounded(name, default))
    surfaces.notes.append(f"{plugin.label}: the texture '{name}' is replaced by its mean.")
    return np.array(surfaces.textures.texture(texture).mean)


def _dielectric(surfaces: Surfaces, plugin: Plugin) -> Surface:
    surfaces.notes.append(f"{plugin.label}: light passes straight, without refraction or blur.")
    return Surface(
        plugin.kind,
        surfaces.textures.value(plugin, "specular_transmittance", 1.0),
        roughness=surfaces.roughness(plugin, 0.1),
        transmission=1.0,
        ior=_ior(plugin),
        double_sided=plugin.kind == "thindielectric",
    )


def _plastic(surfaces: Surfaces, plugin: Plugin) -> Surface:
    ior = _ior(plugin)
    roughness = surfaces.roughness(plugin, 0.1)
    base = surfaces.textures.value(plugin, "diffuse_reflectance", 0.5)
    gain, inside = 1.0, 0.0
    if plugin.kind == "roughplastic":
        distribution = plugin.text("distribution", "beckmann")
        if distribution not in ("beckmann", "ggx"):
            raise plugin.fail(f"the distribution {quoted(distribution)} is not known", "Use beckmann or ggx.")
        alpha = max(roughness.level**2, 1e-3)
        gain, inside = rough_base(ior, round(alpha, 3), distribution, plugin.flag("nonlinear"))
    elif plugin.flag("nonlinear"):
        inside = inner_reflectance(ior)
        gain = 1.0 - inside
    if (gain, inside) != (1.0, 0.0):
        base = base.mapped(lambda rho: np.minimum(gain * rho / (1.0 - rho * inside), 1.0))
    return Surface(plugin.kind, base, roughness=roughness, ior=ior)


def inner_reflectance(ior: float) -> float:
    """Reflectance of a dielectric from within for diffuse light: 1 - (1 - outer) / ior^2 (Egan and Hilgeman 1973)."""
    cosine = (np.arange(512) + 0.5) / 512.0
    below = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    across = (cosine - ior * below) / (cosine + ior * below)
    along = (ior * cosine - below) / (ior * cosine + below)
    outer = float((0.5 * (across**2 + along**2) * 2.0 * cosine).mean())
    return 1.0 - (1.0 - outer) / ior**2


@lru_cache(maxsize=256)
def rough_base(ior: float, alpha: float, distribution: str, nonlinear: bool) -> tuple[float, float]:
    """K and s, so that glTF's dielectric of base colour K rho / (1 - s rho) is as bright as Mitsuba's `roughplastic`.

    Mitsuba's diffuse lobe behind a rough boundary has that form in its reflectance rho. It is measured at three rho for
    diffuse light from all around (bihemispherical albedo), less the glossy lobe's; so is glTF's Lambert times 1 - F.
    """
    # Both directions on grids of equal cosine-weighted solid angle.
    steps_in, steps_out, turns = 16, 32, 32
    cos_in, cos_out, turn = (
        grid.reshape(-1)
        for grid in np.meshgrid(
            np.sqrt((np.arange(steps_in) + 0.5) / steps_in),
            np.sqrt((np.arange(steps_out) + 0.5) / steps_out),
            2.0 * np.pi * (np.arange(turns) + 0.5) / turns,
        )
    )
    sin_in, sin_out = np.sqrt(1.0 - cos_in**2), np.sqrt(1.0 - cos_out**2)
    arriving = (sin_in, np.zeros_like(sin_in), cos_in)
    leaving = (sin_out * np.cos(turn), sin_out * np.sin(turn), cos_out)
    point = dr.zeros(mi.SurfaceInteraction3f, len(turn))
    point.wi, out = (mi.Vector3f(*(mi.Float(x.astype(np.float32)) for x in way)) for way in (arriving, leaving))

    def albedo(rho: float) -> float:
        bsdf = mi.load_dict(
            {
                "type": "roughplastic",
                "int_ior": ior,
                "ext_ior": 1.0,
                "alpha": alpha,
                "distribution": distribution,
                "nonlinear": nonlinear,
                "diffuse_reflectance": {"type": "rgb", "value": rho},
            }
        )
        values = np.array(bsdf.eval(mi.BSDFContext(), point, out), dtype=np.float64).reshape(3, -1)[0]
        return float((values * np.pi / cos_out).mean())

    dark = albedo(0.0)
    half, whole = albedo(0.5) - dark, albedo(1.0) - dark
    inside = (whole - 2.0 * half) / (whole - half)
    length = np.sqrt(sum((a + b) ** 2 for a, b in zip(arriving, leaving, strict=True)))
    cos_half = sum(a * (a + b) for a, b in zip(arriving, leaving, strict=True)) / length
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2
    ours = float(((1.0 - f0) * (1.0 - (1.0 - cos_half) ** 5)).mean())
    return round(whole * (1.0 - inside) / ours, 4), round(inside, 4)


def _principled(surfaces: Surfaces, plugin: Plugin) -> Surface:
    thin = plugin.kind == "principledthin"
    read = {"base_color", "metallic", "roughness", "spec_trans", "specular", "eta", "clearcoat", "clearcoat_gloss"}
    other = sorted(set(plugin.names) - read)
    if other:
        surfaces.notes.append(f"{plugin.label}: {', '.join(map(quoted, other))} ignored.")
    specular = surfaces.share(plugin, "specular", 0.5).level
    ior = plugin.number("eta", 1.5) if thin or plugin.has("eta") else 2.0 / (1.0 - np.sqrt(0.08 * specular)) - 1.0
    transmission = surfaces.share(plugin, "spec_trans", 0.0).level
    if transmission > 0.0:
        surfaces.notes.append(f"{plugin.label}: light passes straight, without refraction or blur.")
    return Surface(
        plugin.kind,
        surfaces.textures.value(plugin, "base_color", 0.5),
        surfaces.share(plugin, "metallic", 0.0),
        surfaces.share(plugin, "roughness", 0.5),
        transmission=transmission,
        ior=max(ior, 1.0),
        clearcoat=surfaces.share(plugin, "clearcoat", 0.0).level,
        double_sided=thin,
    )


def _twosided(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    inner = surfaces.inner(plugin, 2)
    if len(inner) == 2:
        surfaces.notes.append(f"{plugin.label}: its second BSDF is ignored, both sides get the first.")
    return None if inner[0] is None else replace(inner[0], double_sided=True)


def _mask(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    (inner,) = surfaces.inner(plugin)
    if inner is None:
        return None
    opacity = surfaces.share(plugin, "opacity", 0.5)
    if inner.opacity is not WHITE:
        surfaces.notes.append(f"{plugin.label}: a mask in a mask is ignored.")
    # Mitsuba's mask shows the same hole from behind.
    return replace(inner, opacity=opacity)


def _blend(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    pair = surfaces.inner(plugin, 2)
    if len(pair) != 2:
        raise plugin.fail("it holds 1 BSDF", "Put two BSDFs in it.")
    share = surfaces.share(plugin, "weight", 0.5)
    if pair[0] is None or pair[1] is None:
        whole = pair[0] or pair[1]
        cover = share if pair[0] is None else share.mapped(lambda values: 1.0 - values)
        return None if whole is None else replace(whole, opacity=cover)
    surfaces.notes.append(f"{plugin.label}: baked as one surface with the mean of both BSDFs' values.")
    return _mixed(surfaces, pair[0], pair[1], share)


def _mixed(surfaces: Surfaces, first: Surface, second: Surface, share: Value) -> Surface:
    weight = share.level

    def value(name: str) -> Value:
        one: Value = getattr(first, name)
        other: Value = getattr(second, name)
        if one is other:
            return one
        if one.image is None and other.image is None and share.image is None:
            red, green, blue = ((1.0 - weight) * a + weight * b for a, b in zip(one.colour, other.colour, strict=True))
            return replace(one, colour=(red, green, blue))
        (w, a, b), lookup = stacked((share, one, other), surfaces.notes, "BSDF 'blendbsdf'")
        w = (w @ _grey()).astype(np.float32)
        return Value((1.0, 1.0, 1.0), Image("blend", (1.0 - w) * a + w * b, False), lookup)

    def level(name: str) -> float:
        return float((1.0 - weight) * getattr(first, name) + weight * getattr(second, name))

    return Surface(
        "blendbsdf",
        value("base"),
        value("metallic"),
        value("roughness"),
        value("opacity") if first.opacity is not WHITE or second.opacity is not WHITE else WHITE,
        first.normal or second.normal,
        transmission=level("transmission"),
        ior=level("ior"),
        specular=level("specular"),
        clearcoat=level("clearcoat"),
        double_sided=first.double_sided and second.double_sided,
    )


def _bumpmap(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    surfaces.notes.append(f"{plugin.label}: the bumps are ignored.")
    return surfaces.inner(plugin)[0]


def _normalmap(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    (inner,) = surfaces.inner(plugin)
    texture = plugin.child("normalmap")
    if inner is None or texture is None:
        return inner
    return replace(inner, normal=surfaces.textures.texture(texture))


def _coated(surfaces: Surfaces, plugin: Plugin) -> Surface | None:
    (inner,) = surfaces.inner(plugin)
    surfaces.notes.append(f"{plugin.label}: baked as a clear coat.")
    return None if inner is None else replace(inner, clearcoat=1.0)


_BSDFS: Final[Mapping[str, Callable[[Surfaces, Plugin], Surface | None]]] = {
    "diffuse": _diffuse,
    "roughdiffuse": _diffuse,
    "conductor": _conductor,
    "roughconductor": _conductor,
    "dielectric": _dielectric,
    "thindielectric": _dielectric,
    "roughdielectric": _dielectric,
    "plastic": _plastic,
    "roughplastic": _plastic,
    "pplastic": _plastic,
    "principled": _principled,
    "principledthin": _principled,
    "twosided": _twosided,
    "mask": _mask,
    "blendbsdf": _blend,
    "bumpmap": _bumpmap,
    "normalmap": _normalmap,
    "coating": _coated,
    "roughcoating": _coated,
    "null": lambda surfaces, plugin: None,
}
