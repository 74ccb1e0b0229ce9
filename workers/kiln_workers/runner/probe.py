"""Try the renderer and the network once, in a process of its own, and print one JSON object of findings.

`lightkiln doctor` runs it as a subprocess: libLLVM and CUDA libraries can abort a process, and then the parent still
has a sentence to say.
"""

import json
import sys
from importlib.metadata import version
from typing import Any

from kiln_schemas.errors import KilnError


def probe_renderer() -> dict[str, Any]:
    """Compile and run one kernel with the variant that a worker would choose."""
    from kiln_workers.render.backend import select_variant

    variant = select_variant()
    import drjit as dr
    import mitsuba as mi

    total = float(dr.sum(dr.arange(mi.Float, 101))[0])
    return {"variant": variant, "mitsuba": version("mitsuba"), "drjit": version("drjit"), "works": total == 5050.0}


def probe_network() -> dict[str, Any]:
    """Run one convolution and its gradient."""
    import torch

    image = torch.ones(1, 1, 4, 4, requires_grad=True)
    (gradient,) = torch.autograd.grad(torch.nn.functional.conv2d(image, torch.ones(1, 1, 3, 3)).sum(), image)
    works = float(gradient.sum()) == 36.0
    return {"torch": version("torch"), "cuda": torch.cuda.is_available(), "works": works}


PROBES = {"renderer": probe_renderer, "network": probe_network}


def main() -> None:
    """`python -m kiln_workers.runner.probe renderer|network`."""
    try:
        found = PROBES[sys.argv[1]]()
    except KilnError as error:
        found = {"works": False, "detail": error.detail, "remedy": error.remedy}
    except ImportError as error:
        found = {
            "works": False,
            "detail": f"{error.name} is not installed",
            "remedy": "Run: pip install 'lightkiln[worker]'.",
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
