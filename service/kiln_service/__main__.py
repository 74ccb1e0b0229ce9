"""`python -m kiln_service`."""

import sys

from kiln_service.serve import main

sys.exit(main())
