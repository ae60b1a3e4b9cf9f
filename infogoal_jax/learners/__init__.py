"""Goal-representation learners, a file a method. `registry` is the one place where a new method is named."""

from infogoal_jax.learners import cogoal, dgrl, gcb, infobot, infogoal, none, rad, vae
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "gcb": Entry(gcb.GCBConfig, gcb.make),
    "infogoal": Entry(infogoal.InfoGoalConfig, infogoal.make),
    "infobot": Entry(infobot.InfoBotConfig, infobot.make),
    "cogoal": Entry(cogoal.CoGoalConfig, cogoal.make),
    "rad": Entry(rad.RADConfig, rad.make),
    "vae": Entry(vae.VAEConfig, vae.make),
    "dgrl": Entry(dgrl.DGRLConfig, dgrl.make),
    "none": Entry(none.NoneConfig, none.make),
}


def entry(method: str) -> Entry:
    """The registered method of this name, or a `UserError` with the nearest one."""
    return find(registry, "method", method)
