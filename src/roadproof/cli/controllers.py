"""`roadproof controllers`: the shipped controllers, and their cards."""

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

    from roadproof.controllers.shipped import INSTALL, installed_weights, model_card, shipped_names

    cards = [model_card(each) for each in (shipped_names() if name is None else (name,))]
    weights = [installed_weights(card.name) for card in cards]
    megabytes = [None if file is None else file.stat().st_size / 1e6 for file in weights]
    if name is None:
        shown = table(("name", "network", "size", "what it is"))
        for card, size in zip(cards, megabytes, strict=True):
            said = "not installed" if size is None else f"{size:.1f} MB"
            shown.add_row(*map(Text, (card.name, card.network, said, card.summary)))
        say(shown, wrapped=True)
    else:
        _show(cards[0])
    if absent := ", ".join(card.name for card, size in zip(cards, megabytes, strict=True) if size is None):
        say(f"\nThe weights of {absent} are not installed: {INSTALL}")
    answer({"controllers": [asdict(card) | {"megabytes": size} for card, size in zip(cards, megabytes, strict=True)]})


def _show(card: ModelCard) -> None:
    say(f"{card.name}: {card.summary}", wrapped=True)
    for title in ("network", "data", "training", "can", "cannot"):
        # The card's own line ends would meet those of a narrow terminal.
        say(f"\n{title.capitalize()}\n{' '.join(getattr(card, title).split())}", wrapped=True)
