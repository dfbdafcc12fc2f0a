"""Reading and writing: EXR, image folders, video, manifests, foreign formats; the only importers of those libraries."""
