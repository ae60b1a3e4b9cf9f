"""Goal-representation learners, one file each. A new one is registered in `registry`."""

from infogoal_jax.learners import cogoal, dgrl, gcb, infobot, infogoal, leo, none, rad, vae
from infogoal_jax.registry import Entry, Registry

registry = Registry(
    "learner",
    {
        "gcb": Entry(gcb.GCBConfig, gcb.make),
        "infogoal": Entry(infogoal.InfoGoalConfig, infogoal.make, infogoal.InfoGoalHyperparameters),
        "infobot": Entry(infobot.InfoBotConfig, infobot.make, infobot.InfoBotHyperparameters),
        "cogoal": Entry(cogoal.CoGoalConfig, cogoal.make),
        "rad": Entry(rad.RADConfig, rad.make),
        "vae": Entry(vae.VAEConfig, vae.make),
        "dgrl": Entry(dgrl.DGRLConfig, dgrl.make),
        "none": Entry(none.NoneConfig, none.make),
        "leo": Entry(leo.LEOConfig, leo.make, of_agent={"head": "index", "all_goals": True}),
    },
)
