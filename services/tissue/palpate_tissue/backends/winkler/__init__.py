"""The Winkler-Pasternak tissue: springs under the skin, coupled by its shear."""
