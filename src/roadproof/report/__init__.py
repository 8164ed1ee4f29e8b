"""Pictures and films of results: people look before they read."""

from roadproof.report.plots import film_strip as film_strip
from roadproof.report.plots import search_curves as search_curves
