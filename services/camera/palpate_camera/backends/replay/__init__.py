"""A depth camera that shows the frames of a recording instead of rendering what physics says is there."""
