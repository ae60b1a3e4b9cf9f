"""The real loop: a policy of embodied question answering flies a quadcopter of the type Tello in front of a shelf.

| read first | what it holds |
|---|---|
| `flight.py` | the loop: picture, detection, policy, envelope, move; and the landing at the end of every flight |
| `envelope.py` | where the drone may be, which moves are allowed, and what else ends a flight: limits and signals |
| `vision.py` | which images of the video may be trusted, and whether the object is in view |
| `link.py` | commands, state and video, through djitellopy |
| `mission.py` | what the commands put together |
| `records.py` | what a flight leaves behind: its log, and recordings |
| `simulated_tello.py`, `simulated_drone.py` | a Tello in a process of its own, and what it simulates |

Nothing here is imported by the rest of the package but by the commands `infogoal fly` and `infogoal record`, and by
`infogoal report` of a flight.
"""
