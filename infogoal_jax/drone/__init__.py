"""The real loop: a policy of embodied question answering flies a quadcopter of the type Tello in front of a shelf.

| read first | what it holds |
|---|---|
| `flight.py` | the loop: picture, detection, policy, envelope, move; and the landing at the end of every flight |
| `envelope.py` | where the drone may be, which moves are allowed, and what else ends a flight |
| `pictures.py` | which images of the video may be trusted |
| `link.py` | commands, state and video, through djitellopy |
| `detection.py` | whether the object is in view |
| `mission.py`, `signals.py` | what the commands put together; Ctrl-C and its like |
| `log.py`, `recording.py` | what a flight leaves behind |
| `simulated_tello.py`, `simulated_body.py`, `simulated_video.py` | a Tello in a process of its own |

Nothing here is imported by the rest of the package but the commands `infogoal fly` and `infogoal record`.
"""
