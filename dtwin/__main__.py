"""Run the command line with ``python -m dtwin``."""

from dtwin.cli import main

if __name__ == "__main__":
    main()
