"""`python -m motion.onehop`: see `motion.onehop.cli`."""

import sys

from motion.onehop.cli import main

if __name__ == "__main__":
    sys.exit(main())
