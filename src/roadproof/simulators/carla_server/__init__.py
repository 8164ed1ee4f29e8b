"""The embedded town behind CARLA's wire protocol: unmodified CARLA 0.9.16 clients connect to it.

`wire` knows bytes and nothing of worlds; `world` knows actors and time and nothing of bytes; `sensors` makes what
cameras and collision sensors see; `calls` answers the client's calls by name; `server` holds the sockets.
"""
