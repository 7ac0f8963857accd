"""`python -m railnav`: the command line without the installed script."""

from railnav.cli import main

if __name__ == "__main__":
    main(prog_name="railnav")
