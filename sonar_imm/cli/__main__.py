"""``python -m sonar_imm.cli`` is the ``sonar-imm`` command without an installation."""

import sys

from . import main

sys.exit(main())
