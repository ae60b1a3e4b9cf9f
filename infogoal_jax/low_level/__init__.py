"""Training the low level of HRAC, which drives a robot or an arm to target states: `infogoal pretrain`
(docs/reference/low_level.md).

trainer.py   the training program, as pure functions, of any agent for target states; and the file that HRAC loads
fetch.py     the agent of the Fetch robot: TD3 with hindsight
joints.py    the agent of an arm moved by joint steps: double Q-learning over recorded moves
pretraining.py  the configuration and the agent of each task; runs all seeds, writes the curve, keeps the best
"""
