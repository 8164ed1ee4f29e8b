"""What is watched while a car drives, in whatever simulator: what it hits and breaks, and when the drive is over."""
