"""Roads from OpenDRIVE: lanes, junctions, routes, and what lies under a point."""
