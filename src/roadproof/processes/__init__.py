"""Processes that work beside this one."""

from roadproof.processes.fresh import processes_beside as processes_beside
from roadproof.processes.pool import Pool as Pool
from roadproof.processes.pool import here_or_beside as here_or_beside
from roadproof.processes.pool import open_or_here as open_or_here
from roadproof.processes.pool import require_opened as require_opened
from roadproof.processes.pool import spread as spread
from roadproof.processes.pool import stopping as stopping
from roadproof.processes.travel import require_picklable as require_picklable
