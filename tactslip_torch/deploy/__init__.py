"""The detector as ONNX graphs, node by node: raw volts in, scores and alarms out."""
