"""`python -m pipeline` is `slip`."""

from pipeline.cli import main

if __name__ == "__main__":
    main()
