"""What every simulator watches in a drive: what is hit, what rule is broken, when it is over."""
