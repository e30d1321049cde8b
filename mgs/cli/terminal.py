"""The terminal: text is printed as it is, without markup, and names cannot control it."""

from typing import Any

from rich.console import Console
from rich.text import Text

from mgs.errors import printable_lines


class Terminal(Console):
    """Console that reads no markup in text and cells, and escapes control characters in them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, highlight=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable_lines(text), **options)


def echo(text: str) -> None:
    """Print text to the standard output, whatever its width."""
    print(printable_lines(text))
