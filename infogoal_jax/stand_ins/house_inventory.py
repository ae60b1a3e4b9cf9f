"""What stands in the synthetic house: the furniture of each room, the sizes of the 24 objects of the authors' split,
and the ids of all objects."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Piece:
    """A piece of furniture: width along the wall, depth, height in metres; how it is drawn; whether objects stand on
    it."""

    name: str
    width: float
    depth: float
    height: float
    form: str = "cabinet"  # cabinet | table | sofa | screen
    holds: bool = False
    free_standing: bool = False


FURNITURE = {
    "kitchen": (
        Piece("counter", 2.2, 0.6, 0.9, holds=True),
        Piece("table", 1.2, 0.7, 0.75, form="table", holds=True),
        Piece("refrigerator", 0.7, 0.65, 1.8),
        Piece("cupboard", 0.8, 0.4, 1.4),
    ),
    "dining": (
        Piece("dining_table", 1.5, 0.8, 0.75, form="table", holds=True, free_standing=True),
        Piece("sideboard", 1.6, 0.45, 0.85, holds=True),
        Piece("cabinet", 0.9, 0.4, 1.9),
    ),
    "living": (
        Piece("bookcase", 1.3, 0.35, 1.05, holds=True),
        Piece("side_table", 0.9, 0.5, 0.7, form="table", holds=True),
        Piece("sofa", 1.8, 0.8, 0.75, form="sofa"),
        Piece("television", 1.2, 0.4, 0.5, form="screen"),
    ),
    "bathroom": (
        Piece("washbasin", 1.3, 0.5, 0.85, holds=True),
        Piece("shelf", 0.9, 0.35, 1.1, holds=True),
        Piece("bathtub", 1.6, 0.7, 0.55),
        Piece("washing_machine", 0.6, 0.6, 0.9),
    ),
}

# Width, depth, height in metres and form. Somewhat larger than life, so that they can be told apart at 160 x 90 pixels.
OBJECT_SIZES = {
    "advil_liqui_gels": (0.14, 0.10, 0.18, "box"),
    "aunt_jemima_original_syrup": (0.16, 0.12, 0.32, "bottle"),
    "cholula_chipotle_hot_sauce": (0.14, 0.12, 0.30, "bottle"),
    "coca_cola_glass_bottle": (0.15, 0.13, 0.34, "bottle"),
    "crystal_hot_sauce": (0.14, 0.12, 0.31, "bottle"),
    "hersheys_bar": (0.20, 0.12, 0.18, "box"),
    "honey_bunches_of_oats_honey_roasted": (0.20, 0.12, 0.30, "box"),
    "honey_bunches_of_oats_with_almonds": (0.20, 0.12, 0.30, "box"),
    "listerine_green": (0.17, 0.13, 0.32, "bottle"),
    "mahatma_rice": (0.18, 0.13, 0.26, "box"),
    "nature_valley_granola_thins_dark_chocolate": (0.19, 0.12, 0.22, "box"),
    "nature_valley_sweet_and_salty_nut_almond": (0.19, 0.12, 0.21, "box"),
    "nature_valley_sweet_and_salty_nut_cashew": (0.19, 0.12, 0.21, "box"),
    "nature_valley_sweet_and_salty_nut_peanut": (0.19, 0.12, 0.21, "box"),
    "nature_valley_sweet_and_salty_nut_roasted_mix_nut": (0.19, 0.12, 0.21, "box"),
    "nutrigrain_harvest_blueberry_bliss": (0.19, 0.12, 0.22, "box"),
    "paper_plate": (0.22, 0.12, 0.22, "box"),
    "pepto_bismol": (0.15, 0.12, 0.28, "bottle"),
    "quaker_chewy_low_fat_chocolate_chunk": (0.19, 0.12, 0.22, "box"),
    "softsoap_clear": (0.15, 0.12, 0.26, "bottle"),
    "softsoap_gold": (0.15, 0.12, 0.26, "bottle"),
    "spongebob_squarepants_fruit_snaks": (0.19, 0.12, 0.24, "box"),
    "tapatio_hot_sauce": (0.14, 0.12, 0.30, "bottle"),
    "vo5_tea_therapy_healthful_green_tea_smoothing_shampoo": (0.15, 0.12, 0.33, "bottle"),
}

# The instance map of the real dataset, ids 1 to 33.
INSTANCE_NAMES = """
advil_liqui_gels aunt_jemima_original_syrup bumblebee_albacore cholula_chipotle_hot_sauce coca_cola_glass_bottle
crest_complete_minty_fresh crystal_hot_sauce expo_marker_red hersheys_bar honey_bunches_of_oats_honey_roasted
honey_bunches_of_oats_with_almonds hunts_sauce listerine_green mahatma_rice nature_valley_granola_thins_dark_chocolate
nutrigrain_harvest_blueberry_bliss pepto_bismol pringles_bbq progresso_new_england_clam_chowder
quaker_chewy_low_fat_chocolate_chunk red_bull softsoap_clear softsoap_gold softsoap_white
spongebob_squarepants_fruit_snaks tapatio_hot_sauce vo5_tea_therapy_healthful_green_tea_smoothing_shampoo
nature_valley_sweet_and_salty_nut_almond nature_valley_sweet_and_salty_nut_cashew
nature_valley_sweet_and_salty_nut_peanut nature_valley_sweet_and_salty_nut_roasted_mix_nut paper_plate red_cup
""".split()
INSTANCE_IDS = {name: identity for identity, name in enumerate(INSTANCE_NAMES, 1)}
