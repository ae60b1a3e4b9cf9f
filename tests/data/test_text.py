"""Text goals: the shipped embeddings, looking texts up, and the file format."""

import shlex

import numpy as np
import pytest

from infogoal_jax.cli import data
from infogoal_jax.data import sentence_encoder, text
from infogoal_jax.errors import UserError
from infogoal_jax.runs.folder import locked

# all_instance_id_map.txt of the Active Vision Dataset, spelled as there ("snaks" too).
INSTANCE_NAMES = """
    advil_liqui_gels aunt_jemima_original_syrup bumblebee_albacore cholula_chipotle_hot_sauce coca_cola_glass_bottle
    crest_complete_minty_fresh crystal_hot_sauce expo_marker_red hersheys_bar honey_bunches_of_oats_honey_roasted
    honey_bunches_of_oats_with_almonds hunts_sauce listerine_green mahatma_rice
    nature_valley_granola_thins_dark_chocolate nutrigrain_harvest_blueberry_bliss pepto_bismol pringles_bbq
    progresso_new_england_clam_chowder quaker_chewy_low_fat_chocolate_chunk red_bull softsoap_clear softsoap_gold
    softsoap_white spongebob_squarepants_fruit_snaks tapatio_hot_sauce
    vo5_tea_therapy_healthful_green_tea_smoothing_shampoo nature_valley_sweet_and_salty_nut_almond
    nature_valley_sweet_and_salty_nut_cashew nature_valley_sweet_and_salty_nut_peanut
    nature_valley_sweet_and_salty_nut_roasted_mix_nut paper_plate red_cup
""".split()


def test_shipped_embeddings_have_every_object_of_the_dataset():
    embeddings = text.load_shipped()
    vectors = text.embed_known([*INSTANCE_NAMES, "Coca-Cola glass bottle"])
    assert len(INSTANCE_NAMES) == 33
    assert vectors.shape == (34, text.EMBEDDING_SIZE) and vectors.dtype == np.float32
    assert len(np.unique(vectors, axis=0)) == 34
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-6)
    assert embeddings.weights_sha256 == sentence_encoder.OFFICIAL["model.safetensors"]
    assert embeddings.model == sentence_encoder.MODEL


def test_shipped_embeddings_put_like_objects_close():
    shop = ["tapatio_hot_sauce", "cholula_chipotle_hot_sauce", "coca_cola_glass_bottle", "Coca-Cola glass bottle"]
    vectors = text.embed_known(shop)
    cosine = vectors @ vectors.T
    assert cosine[0, 1] == pytest.approx(0.584, abs=1e-3)  # two hot sauces
    assert cosine[0, 2] == pytest.approx(0.227, abs=1e-3)  # a hot sauce and a bottle
    assert cosine[2, 3] == pytest.approx(0.994, abs=1e-3)  # two spellings


@pytest.mark.parametrize("variant", ["red bull", "red_bull", "Red-Bull", "  RED \t bull ", "red__bull"])
def test_spelling_variants_are_one_text(variant):
    np.testing.assert_array_equal(text.embed_known([variant]), text.embed_known(["red bull"]))


def test_a_spelling_that_the_file_has_wins_over_a_variant_of_it():
    embeddings = text.load_shipped()
    rows = [embeddings.texts.index("Coca-Cola glass bottle"), embeddings.texts.index("coca cola glass bottle")]
    found = text.embed_known(["coca-cola  GLASS bottle", "Coca_Cola glass bottle"], embeddings)
    np.testing.assert_array_equal(found, embeddings.vectors[rows])


def test_looking_up_keeps_order_and_repetition_and_cannot_change_the_embeddings():
    embeddings = text.load_shipped()
    found = text.embed_known(["red cup", "red bull", "red cup"], embeddings)
    np.testing.assert_array_equal(found[0], found[2])
    assert not np.array_equal(found[0], found[1])
    found[:] = 0.0
    np.testing.assert_allclose(np.linalg.norm(embeddings.vectors, axis=1), 1.0, atol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        embeddings.vectors[0] = 0.0
    assert text.embed_known([]).shape == (0, text.EMBEDDING_SIZE)


def test_an_unknown_text_is_an_error_with_suggestions_and_the_command_that_embeds_it():
    with pytest.raises(UserError) as caught:
        text.embed_known(["red cup", "red-bul", "Grandma's $5 vase"])
    message = str(caught.value)
    assert "'red-bul'" in message and "'red bull'" in message
    assert "'red cup' is known" not in message
    remedy, _, command = message.splitlines()[-1].partition(": ")
    assert "give --env.text-embeddings my_embeddings.npz" in remedy
    assert shlex.split(command) == [  # All of them: the new file stands in place of the shipped one.
        "infogoal",
        "data",
        "embed",
        "red cup",
        "red-bul",
        "Grandma's $5 vase",
        "--out",
        "my_embeddings.npz",
    ]


def test_one_text_in_place_of_a_list_is_an_error():
    with pytest.raises(UserError, match="list of texts"):
        text.embed_known("red cup")


def made_up_embeddings(*texts, weights_sha256="0" * 64):
    vectors = np.random.default_rng(len(texts)).normal(size=(len(texts), text.EMBEDDING_SIZE))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return text.TextEmbeddings(texts, vectors, weights_sha256, "made up")


def test_what_is_saved_is_loaded(tmp_path):
    saved = made_up_embeddings("a red mug", "una caña, 日本 ☕")
    path = tmp_path / "new folder" / "embeddings"  # numpy would add a suffix to the name
    text.save(path, saved)
    loaded = text.load(path)
    assert (loaded.texts, loaded.weights_sha256, loaded.model) == (saved.texts, saved.weights_sha256, saved.model)
    np.testing.assert_array_equal(loaded.vectors, saved.vectors)
    assert [file.name for file in path.parent.iterdir()] == ["embeddings"]


def test_embeddings_have_one_writer_at_a_time(tmp_path):
    """Each reads the file and writes it with more texts: the second would undo what the first added."""
    path = tmp_path / "embeddings.npz"
    text.save(path, made_up_embeddings("old"))
    before = path.read_bytes()
    with (
        locked(tmp_path / ".embeddings.npz.lock", path),
        pytest.raises(UserError, match="is being written by another process"),
    ):
        data.embed(("new",), str(path), str(tmp_path / "no weights"))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_damaged_file_is_a_user_error_and_never_wrong_numbers(tmp_path):
    path = tmp_path / "embeddings.npz"
    embeddings = made_up_embeddings("a", "b")
    text.save(path, embeddings)
    whole = path.read_bytes()
    damaged = [whole[:length] for length in (0, 1, 100, len(whole) // 2, len(whole) - 1)]
    for position in range(0, len(whole), 7):
        damaged.append(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
    refused = 0
    for content in damaged:
        path.write_bytes(content)
        try:
            loaded = text.load(path)
        except UserError as error:
            assert str(path) in str(error)
            refused += 1
        else:  # the flipped byte was one that nobody reads, such as a time stamp
            assert loaded.texts == embeddings.texts and loaded.weights_sha256 == embeddings.weights_sha256
            np.testing.assert_array_equal(loaded.vectors, embeddings.vectors)
    assert refused > len(damaged) // 2


def test_files_that_are_something_else_are_user_errors(tmp_path):
    path = tmp_path / "embeddings.npz"
    with pytest.raises(UserError, match="no such file; make it: infogoal data embed"):
        text.load(path)
    with pytest.raises(UserError, match="cannot be read"):
        text.load(tmp_path)
    np.savez(path, texts=np.array(["a"]))
    with pytest.raises(UserError, match="vectors, weights_sha256, model missing; take it away"):
        text.load(path)
    fields = dict(weights_sha256=np.array("0"), model=np.array("made up"))
    unit = np.eye(1, text.EMBEDDING_SIZE, dtype=np.float32)
    for texts, vectors, problem in [
        (np.array(["a", "b"]), unit, "vectors: has 1 texts, but texts has 2"),  # more texts than vectors
        (np.array(["a"], object), unit, "texts = unreadable.*pickled"),
        (np.array(["a"]), 2.0 * unit, "length 1"),
        (np.array(["a"]), np.nan * unit, r"vectors\[0\].*finite"),
        (np.array(["a"]), unit[:, :-1], r"vectors: has the shape \[1, 383\]; give \[texts, 384\]"),
        (np.array(["a"]), unit.astype(np.int64), "vectors: is int64; give float32"),
    ]:
        np.savez(path, texts=texts, vectors=vectors, **fields)
        with pytest.raises(UserError, match=f"embeddings.npz.*{problem}"):
            text.load(path)


def test_a_write_that_fails_says_why_even_where_nothing_can_be_tidied_up(tmp_path):
    (tmp_path / "a_file").write_text("kept")
    with pytest.raises(UserError, match="cannot be written.*give another place"):
        text.save(tmp_path / "a_file" / "embeddings.npz", made_up_embeddings("a"))


def test_merging_keeps_the_first_of_each_text_and_refuses_other_weights():
    first, second = made_up_embeddings("a", "b"), made_up_embeddings("b", "c", "d")
    merged = text.merge(first, second)
    assert merged.texts == ("a", "b", "c", "d")
    np.testing.assert_array_equal(merged.vectors, np.concatenate([first.vectors, second.vectors[1:]]))
    with pytest.raises(UserError, match="different weights"):
        text.merge(first, made_up_embeddings("c", weights_sha256="1" * 64))
