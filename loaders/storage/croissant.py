"""Croissant 1.1 metadata of Parquet files, with the fields of responsible AI that conferences ask
for: what tools and forms read of a dataset, https://docs.mlcommons.org/croissant."""

import json
from collections.abc import Mapping, Sequence
from datetime import date
from typing import Any

from fpp_ml_bench import RELEASED
from fpp_ml_bench.loaders.sample import MEANINGS
from fpp_ml_bench.loaders.storage.card import DOI, NAME, limitations, title
from fpp_ml_bench.loaders.storage.manifest import GENERATED, Manifest

FILE = "croissant.json"
_TYPES = {
    "string": "sc:Text",
    "float32": "cr:Float32",
    "float64": "cr:Float64",
    "uint8": "cr:UInt8",
}
_TERMS = {
    "arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field",
    "fileObject", "fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset",
    "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex", "repeated",
    "replace", "samplingRate", "separator", "source", "subField", "transform",
}  # fmt: skip
"""Of the vocabulary of Croissant, each `cr:` and its own name."""
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "prov": "http://www.w3.org/ns/prov#",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "name": {"@container": "@language"},
    "description": {"@container": "@language"},
    **{term: f"cr:{term}" for term in sorted(_TERMS)},
}


def croissant(
    manifest: Manifest,
    described: Mapping[str, Mapping[str, Any]],
    splits: Sequence[str],
    licence: str,
    repository: str = "",
) -> bytes:
    """The JSON-LD of Parquet files ``data/SPLIT-*.parquet`` beside it, whose columns are
    ``described`` as `sample.features` does; with a ``repository`` on the Hub they are those of its
    main branch. ``licence`` is an identifier of SPDX or the Hub, "unknown" where nobody named
    one."""
    generated = manifest.origin == GENERATED
    address = (
        f"https://huggingface.co/datasets/{repository}" if repository else f"https://doi.org/{DOI}"
    )
    owner = f"The {NAME} authors" if generated else repository.partition("/")[0] or "not named"
    files: list[dict[str, Any]] = []
    if repository:
        files.append(
            {
                "@type": "cr:FileObject",
                "@id": "repository",
                "name": "repository",
                "contentUrl": address,
                "encodingFormat": "git+https",
                # A repository has no hash of its own; this is what the Hub's own files say.
                "sha256": "https://github.com/mlcommons/croissant/issues/80",
            }
        )
    for split in splits:
        files.append(
            {
                "@type": "cr:FileSet",
                "@id": split,
                "name": split,
                "encodingFormat": "application/x-parquet",
                "includes": f"data/{split}-*.parquet",
                **({"containedIn": {"@id": "repository"}} if repository else {}),
            }
        )
    content = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        "name": repository.rpartition("/")[2]
        or f"{title(manifest)} {manifest.origin}".replace(" ", "-"),
        "description": (
            f"Frames of fringe projection and depth in mm, {manifest.size[1]} x "
            f"{manifest.size[0]} px, {manifest.origin}; fingerprint {manifest.fingerprint}."
        ),
        "url": address,
        "license": licence
        if licence == "unknown"
        else f"https://choosealicense.com/licenses/{licence}/",
        "version": f"1.0.{int(manifest.fingerprint[:7], 16)}",
        # Of other people's data it is not known when they were published, and by whom.
        "datePublished": RELEASED if generated else date.today().isoformat(),
        "creator": {"@type": "sc:Organization", "name": owner},
        "keywords": ["fringe projection profilometry", "structured light", "depth estimation"],
        "citeAs": f"Haroon et al., https://doi.org/{DOI}",
        **_responsible(manifest, generated),
        "distribution": files,
        "recordSet": [_records(split, described) for split in splits],
    }
    return (json.dumps(content, indent=1) + "\n").encode()


def _records(split: str, described: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The rows of a split, a field for each column."""
    fields = []
    for name, feature in described.items():
        image = feature["_type"] == "Image"
        shape = feature.get("shape")
        unit, meaning = MEANINGS["frame" if name.startswith("frame_") else name]
        extract: dict[str, Any] = {"extract": {"column": name}}
        if image:
            extract["transform"] = {"jsonPath": "bytes"}
        fields.append(
            {
                "@type": "cr:Field",
                "@id": f"{split}-rows/{name}",
                "name": name,
                "description": f"{meaning} ({unit})" if unit else meaning,
                "dataType": "sc:ImageObject" if image else _TYPES[feature["dtype"]],
                **({"isArray": True, "arrayShape": ",".join(map(str, shape))} if shape else {}),
                "source": {"fileSet": {"@id": split}, **extract},
            }
        )
    return {"@type": "cr:RecordSet", "@id": f"{split}-rows", "name": split, "field": fields}


def _responsible(manifest: Manifest, generated: bool) -> dict[str, Any]:
    """How the data came about, what it is for and what it lacks."""
    made = " ".join(manifest.generator.values())
    if generated:
        collected = "Rendered by a model of projector, surfaces and camera; nobody was observed."
        biases = (
            "Objects are tools, toys and household goods of one material model, in front of a wall, "
            "before one rig: methods may learn these shapes, this range and this light."
        )
    else:
        collected = (
            "Captured by a camera and a projector, or imported from files; decoded from all frames."
        )
        biases = (
            "Objects, surfaces and rig are those that the owner had: no sample of anything larger."
        )
    return {
        "rai:dataCollection": collected,
        "rai:dataCollectionType": "Software Collection" if generated else "Observations",
        "rai:dataBiases": biases,
        "rai:dataLimitations": limitations(manifest),
        "rai:personalSensitiveInformation": "None: no person, place or owner is in the data."
        if generated
        else "Not examined: the owner of captures knows what they show.",
        "rai:dataUseCases": (
            "Training and scoring of methods that measure depth from fringe images. Not for safety "
            "decisions, nor as evidence that a scanner conforms to a standard."
        ),
        "rai:dataSocialImpact": (
            "Comparable figures for optical metrology; no use against persons is known to its authors."
        ),
        "rai:dataReleaseMaintenancePlan": (
            "A change of the content is a new version with another fingerprint; older rows keep theirs."
        ),
        "rai:hasSyntheticData": generated,
        "prov:wasGeneratedBy": made,
        "prov:wasDerivedFrom": manifest.settings.get("set", {}).get("source")
        or manifest.settings.get("repository")
        or ("nothing: it is rendered" if generated else "files of its owner"),
    }
