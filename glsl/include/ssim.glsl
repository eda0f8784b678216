// SSIM's window (11 x 11, sigma 1.5, separable; sums to one) and constants for values in [0, 1] (Wang et al. 2004).
const int RADIUS = 5;
const float WINDOW[11] = float[](0.0010283801, 0.0075987581, 0.0360007721, 0.1093606895, 0.2130055377, 0.2660117249,
                                 0.2130055377, 0.1093606895, 0.0360007721, 0.0075987581, 0.0010283801);
const float C1 = 0.0001;
const float C2 = 0.0009;
