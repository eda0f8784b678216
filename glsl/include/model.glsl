// Sizes of the representation (Scaffold-GS): OFFSETS Gaussians per anchor is a specialisation constant of the kernels
// that need it; features, hidden units and the decoder's input are fixed.
const uint FEATURE = 32u;
const uint HIDDEN = 32u;
const uint INPUT = 36u; // feature 32, unit view direction 3, distance 1
