"""What each table and figure of the paper shows; known without JAX, for the help of the command line."""

DESCRIPTIONS = {
    "table1": "Table I: success of every method on every task",
    "table2": "Table II: beta and accuracy that InfoGoal converges to",
    "fig8": "Fig. 8: sample efficiency and optimality with and without SSE-DB",
    "fig9": "Fig. 9: codes and ways under corruption, external rewards alone",
    "fig10": "Fig. 10: codes and trajectories on object search",
    "fig11": "Fig. 11: codes and flights on embodied question answering",
    "fig12": "Fig. 12: the intrinsic reward over states",
    "fig13": "Fig. 13: beta and accuracy while training",
    "fig14": "Fig. 14: codes under fixed beta",
    "fig15": "Fig. 15: success under fixed beta and under the adaptive one",
}
