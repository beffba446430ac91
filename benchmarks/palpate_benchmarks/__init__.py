"""Speed of the parts and of whole runs (`palpate bench`), and the fault campaign (`palpate faults`)."""
