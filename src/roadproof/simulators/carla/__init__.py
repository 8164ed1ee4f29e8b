"""A CARLA server as a simulator, through CARLA's own client, which is imported in this folder alone.

`session` keeps the connection and puts back what it found; `cameras` waits for the pictures of a tick; `actors` places
the car and the traffic; `signals` tells which lights and signs the car runs; `inject` paints the canvas into pictures;
`simulator` is what `roadproof` drives.
"""

from roadproof.simulators.carla.simulator import CarlaSimulator as CarlaSimulator
