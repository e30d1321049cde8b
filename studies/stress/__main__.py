"""Run the experiments: `python -m studies.stress OUT`."""

from studies.commands import start

if __name__ == "__main__":
    start("stress")
