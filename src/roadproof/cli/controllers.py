"""`roadproof controllers`: the controllers that come with the package, and their cards."""

from __future__ import annotations

from typing import Annotated

from roadproof.cli.options import argument
from roadproof.cli.output import table


def controllers(
    name: Annotated[str | None, argument("One of them, to read its card.")] = None,
) -> None:
    """List the shipped controllers, or show the card of one."""
    from rich.console import Console
    from rich.text import Text

    from roadproof.controllers.shipped import model_card, shipped_names, shipped_weights

    if name is None:
        shown = table(("name", "network", "size", "what it is"))
        for each in shipped_names():
            card = model_card(each)
            size = f"{shipped_weights(each).stat().st_size / 1e6:.1f} MB"
            shown.add_row(*map(Text, (each, card.network, size, card.summary)))
        Console().print(shown)
        return
    card = model_card(name)
    say = Console(highlight=False, markup=False).print
    say(f"{card.name}: {card.summary}")
    for title in ("network", "data", "training", "can", "cannot"):
        # The card's own line ends would meet those of a narrow terminal.
        say(f"\n{title.capitalize()}\n{' '.join(getattr(card, title).split())}")
