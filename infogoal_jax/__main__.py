"""`python -m infogoal_jax` is the command `infogoal`."""

import sys

from infogoal_jax.cli.entry import main

if __name__ == "__main__":
    sys.exit(main())
