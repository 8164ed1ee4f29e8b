"""Checks of what a user brings and of what a search found: what was seen, and what to do where one fails."""

from __future__ import annotations

from dataclasses import dataclass

from roadproof.io.html import table


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at, and whether it is as it should be.

    Args:
        name: short name of the check, the same in all versions.
        passed: whether it is as it should be.
        finding: what was measured or seen, in words.
        advice: what to do if the check fails; empty where there is nothing to say.
    """

    name: str
    passed: bool
    finding: str
    advice: str = ""

    def __str__(self) -> str:
        advice = "" if self.passed or not self.advice else f"; {self.advice}"
        return f"{'ok ' if self.passed else 'BAD'} {self.name}: {self.finding}{advice}"


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All checks in the order in which they were made, without those that an earlier failure makes impossible."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return not self.failures

    @property
    def failures(self) -> tuple[Check, ...]:
        """The checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    def __str__(self) -> str:
        failed = len(self.failures)
        verdict = f"{failed} of {len(self.checks)} checks failed" if failed else "all checks passed"
        return "\n".join([*map(str, self.checks), verdict])

    def _repr_html_(self) -> str:
        """How a notebook shows it: a row for each check."""
        rows = [
            (c.name, "kept" if c.passed else "broken", c.finding, "" if c.passed else c.advice) for c in self.checks
        ]
        return table(("promise", "", "found", "what to do"), rows)
