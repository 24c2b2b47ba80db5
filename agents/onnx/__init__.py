"""ONNX files as egos, and the export of egos to them."""

from agents.onnx.ego import OnnxEgo
from agents.onnx.export import ExportReport, export_onnx

__all__ = ["ExportReport", "OnnxEgo", "export_onnx"]
