"""`python -m jaxcloseup` is the command `jaxcloseup`."""

from jaxcloseup.app.cli.main import main


if __name__ == "__main__":
    main()
