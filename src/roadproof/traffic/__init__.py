"""Others on the road: cars that keep their lanes, people on foot; where they are at every instant, by seed."""
