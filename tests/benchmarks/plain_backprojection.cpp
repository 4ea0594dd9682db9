// Backprojection as one writes it down, for comparison: f(p) = sum_v z_v(d_vp) exp(2jk d_vp), z_v interpolated
// linearly, the carrier by a sine and a cosine for every pair of view and pixel.
#include <cmath>
#include <complex>

extern "C" void backproject(const std::complex<float> *rows, const float *antennas, int views, int bins, float start,
                            float step, float wavenumber, const float *points, int pixels, std::complex<float> *out)
{
#pragma omp parallel for
    for (int p = 0; p < pixels; p++) {
        float re = 0, im = 0;
        for (int v = 0; v < views; v++) {
            const float *a = antennas + 3 * v;
            const float dx = points[2 * p] - a[0], dy = points[2 * p + 1] - a[1];
            const float d = std::sqrt(dx * dx + dy * dy + a[2] * a[2]), at = (d - start) / step;
            const int bin = (int)at;
            if (bin < 0 || bin + 1 >= bins)
                continue;
            const std::complex<float> *row = rows + (long)v * bins + bin;
            const float w = at - bin, zr = (1 - w) * row[0].real() + w * row[1].real();
            const float zi = (1 - w) * row[0].imag() + w * row[1].imag();
            const float c = std::cos(2 * wavenumber * d), s = std::sin(2 * wavenumber * d);
            re += zr * c - zi * s;
            im += zr * s + zi * c;
        }
        out[p] = {re, im};
    }
}
