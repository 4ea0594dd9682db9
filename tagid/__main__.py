"""`python -m tagid`: the same program as `tagid`, for places where scripts are not on the path."""

from tagid.cli.app import main

if __name__ == "__main__":
    main()
