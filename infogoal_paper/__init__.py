"""The paper's tables and figures from training to the finished page: `infogoal reproduce`
(docs/research/reproduction.md)."""
