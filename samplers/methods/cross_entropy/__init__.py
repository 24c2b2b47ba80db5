"""Cross-entropy method of O'Kelly et al. 2018, and the blocks of coordinates that it can search by."""

from samplers.methods.cross_entropy.beta_block import BetaBlock
from samplers.methods.cross_entropy.blocks import Product
from samplers.methods.cross_entropy.gaussian_blocks import GaussianBlock, MappedBlock, MixtureBlock, NormalBlock
from samplers.methods.cross_entropy.method import CrossEntropy

__all__ = ["BetaBlock", "CrossEntropy", "GaussianBlock", "MappedBlock", "MixtureBlock", "NormalBlock", "Product"]
