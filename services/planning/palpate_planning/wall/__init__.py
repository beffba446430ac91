"""The abdominal wall as planning believes it to be: perceived surface, correction from touches, breathing."""
