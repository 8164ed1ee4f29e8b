"""Drives of your own: pictures and a table in, recordings out."""

from roadproof.drives.own.recordings import import_drives as import_drives
from roadproof.drives.own.recordings import preview as preview
