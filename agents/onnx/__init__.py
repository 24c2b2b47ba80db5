"""ONNX files as egos, and the export of egos to them."""
