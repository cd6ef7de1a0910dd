"""`python -m nnss_cli` is `nnss`."""

from nnss_cli.app import main

if __name__ == "__main__":
    main()
