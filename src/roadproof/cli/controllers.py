"""`roadproof controllers`: the controllers that come with the package, and their cards."""

from __future__ import annotations

from typing import Annotated

import typer


def controllers(
    name: Annotated[str | None, typer.Argument(help="One of them, to read its card.", show_default=False)] = None,
) -> None:
    """List the shipped controllers, or show the card of one."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from roadproof.controllers.shipped import model_card, shipped_names, shipped_weights

    if name is None:
        table = Table("name", "network", "size", "what it is", box=box.SIMPLE)
        for each in shipped_names():
            card = model_card(each)
            size = f"{shipped_weights(each).stat().st_size / 1e6:.1f} MB"
            table.add_row(*map(Text, (each, card.network, size, card.summary)))
        Console().print(table)
        return
    card = model_card(name)
    say = Console(highlight=False, markup=False).print
    say(f"{card.name}: {card.summary}")
    for title in ("network", "data", "training", "can", "cannot"):
        # The card's own line ends would meet those of a narrow terminal.
        say(f"\n{title.capitalize()}\n{' '.join(getattr(card, title).split())}")
