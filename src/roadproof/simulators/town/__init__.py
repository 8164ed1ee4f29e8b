"""The embedded town: roads from OpenDRIVE, Panda3D's software renderer and Bullet's vehicle physics, on one CPU core."""
