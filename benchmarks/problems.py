"""Several things that are wrong with what a user brought."""

from collections.abc import Sequence

from ash.files import InputError

MOST_LINES = 100


class Problems(InputError):
    """`lines` names each problem, at most `MOST_LINES` of them; as one text, the first and how many more there are."""

    def __init__(self, lines: Sequence[str]) -> None:
        super().__init__(lines[0] + (f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""))
        self.lines = [str(InputError(line)) for line in lines[:MOST_LINES]]
        if len(lines) > MOST_LINES:
            self.lines.append(f"and {len(lines) - MOST_LINES} more")
