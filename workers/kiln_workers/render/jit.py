"""Dr.Jit and Mitsuba without their type stubs.

The stubs describe no variant that is ever selected (array types change with `select_variant`), so to the type checker
both are Any. Import `dr` and `mi` from here; importing loads no backend.
"""

from typing import Any

import drjit
import mitsuba

dr: Any = drjit
mi: Any = mitsuba
