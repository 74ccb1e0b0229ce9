"""The browser's pixels are those of `lightkiln shade`, term by term (`same_picture`)."""

import numpy as np
import packages
import pytest
from same_picture import FINER, HEIGHT, LEAST_PSNR, WIDTH, Reference

from kiln_schemas.camera import read_camera
from kiln_workers.shade.term import WHOLE, Term


@pytest.mark.parametrize("name", packages.SCENES)
def test_each_term_is_the_evaluator_s(name, made, serve, viewer, capture, record_property) -> None:
    folder = made(name)
    camera = read_camera(packages.CAMERAS[name])
    reference = Reference.of(folder, camera)
    package, white = reference.package, reference.white
    left_out = 1.0 - reference.inner.mean()
    record_property("left_out", float(left_out))
    lit = [*WHOLE, Term.UNOCCLUDED] if package.environment else [Term.EMISSION, Term.DIFFUSE, Term.INTERREFLECTION]
    told = []
    with serve(folder) as url:
        page = viewer.open(url, viewport={"width": 320, "height": 200})
        for terms in ([WHOLE] if package.environment else [lit]) + [[term] for term in lit]:
            expected = reference.picture(terms)
            if name not in ("courtyard", "veils", "bumps") or terms != [Term.EMISSION]:  # nothing glows there
                assert expected[reference.inner].max() > 0.05 * white, terms
            psnr = reference.psnr(capture(page, camera, terms, WIDTH, HEIGHT, FINER), terms)
            record_property("+".join(terms), float(psnr))
            told.append((name, "+".join(terms), round(psnr, 1)))
            assert psnr >= LEAST_PSNR, told
        # The measure tells pictures apart that differ little: one pixel to the side, one term for another.
        diffuse = capture(page, camera, [Term.DIFFUSE], WIDTH, HEIGHT, FINER)
        assert reference.psnr(np.roll(diffuse, 1, axis=1), [Term.DIFFUSE]) < LEAST_PSNR
        assert reference.psnr(diffuse, [Term.INTERREFLECTION]) < LEAST_PSNR
    print(told, f"left out {left_out:.4f}")
