"""`roadproof controllers`: the controllers that come with the package, and their cards."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

from roadproof.cli.options import argument
from roadproof.cli.output import answer, say, table

if TYPE_CHECKING:
    from roadproof.controllers.shipped import ModelCard


def controllers(
    name: Annotated[str | None, argument("One of them, to read its card.")] = None,
) -> None:
    """List the shipped controllers, or show the card of one."""
    from rich.text import Text

    from roadproof.controllers.shipped import model_card, shipped_names, shipped_weights

    cards = [model_card(each) for each in (shipped_names() if name is None else (name,))]
    megabytes = [shipped_weights(card.name).stat().st_size / 1e6 for card in cards]
    if name is None:
        shown = table(("name", "network", "size", "what it is"))
        for card, size in zip(cards, megabytes, strict=True):
            shown.add_row(*map(Text, (card.name, card.network, f"{size:.1f} MB", card.summary)))
        say(shown, wrapped=True)
    else:
        _show(cards[0])
    answer({"controllers": [asdict(card) | {"megabytes": size} for card, size in zip(cards, megabytes, strict=True)]})


def _show(card: ModelCard) -> None:
    say(f"{card.name}: {card.summary}", wrapped=True)
    for title in ("network", "data", "training", "can", "cannot"):
        # The card's own line ends would meet those of a narrow terminal.
        say(f"\n{title.capitalize()}\n{' '.join(getattr(card, title).split())}", wrapped=True)
