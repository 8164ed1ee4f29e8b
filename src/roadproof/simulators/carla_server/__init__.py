"""The embedded town behind CARLA's wire protocol: unmodified CARLA 0.9.16 clients connect to it.

`wire` knows bytes and nothing of worlds; `world` knows actors and time and nothing of bytes; `sensors` makes what
cameras and collision sensors see. What clients send may be anything: `requests` cuts it into calls, `arguments` holds
types and ranges, `calls` answers by name, `connections` bounds what clients can hold, and `limits` has the numbers.
`ports` listens, and `server` puts all together.
"""
