/* Small Hermitian positive systems of the compiled loops. SIDE is the width of the arrays that hold them. */
#ifndef TAGID_HERMITIAN_H
#define TAGID_HERMITIAN_H

/* Cholesky factor of a Hermitian positive matrix, in place below the diagonal. */
INLINE void factorise(int k, double (*g)[SIDE][2])
{
    for (int j = 0; j < k; j++) {
        double d = g[j][j][0];
        for (int s = 0; s < j; s++)
            d -= g[j][s][0] * g[j][s][0] + g[j][s][1] * g[j][s][1];
        d = sqrt(d > 1e-300 ? d : 1e-300);
        g[j][j][0] = d;
        for (int i = j + 1; i < k; i++) {
            double re = g[i][j][0], im = g[i][j][1];
            for (int s = 0; s < j; s++) {
                re -= g[i][s][0] * g[j][s][0] + g[i][s][1] * g[j][s][1];
                im -= g[i][s][1] * g[j][s][0] - g[i][s][0] * g[j][s][1];
            }
            g[i][j][0] = re / d;
            g[i][j][1] = im / d;
        }
    }
}

/* x = G^-1 x by the factor. */
INLINE void substitute(int k, double (*g)[SIDE][2], double (*x)[2])
{
    for (int i = 0; i < k; i++) {
        for (int s = 0; s < i; s++) {
            x[i][0] -= g[i][s][0] * x[s][0] - g[i][s][1] * x[s][1];
            x[i][1] -= g[i][s][0] * x[s][1] + g[i][s][1] * x[s][0];
        }
        x[i][0] /= g[i][i][0];
        x[i][1] /= g[i][i][0];
    }
    for (int i = k - 1; i >= 0; i--) {
        for (int s = i + 1; s < k; s++) {
            x[i][0] -= g[s][i][0] * x[s][0] + g[s][i][1] * x[s][1];
            x[i][1] -= g[s][i][0] * x[s][1] - g[s][i][1] * x[s][0];
        }
        x[i][0] /= g[i][i][0];
        x[i][1] /= g[i][i][0];
    }
}

#endif
