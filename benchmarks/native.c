/* Triple pendulum (RRR) with general mass centres and inertias, by fixed steps.

   Reduced 3x3 equations in absolute angles, polynomial sine and cosine, everything in
   registers or L1. Compiled once with LANES = 32 (structure of arrays, four AVX-512
   vectors) and once with LANES = 1.
   tableau.h is written by native.py: STAGES, A, B of an explicit Runge-Kutta method. */

#include "tableau.h"

#define FOR_LANES for (int l = 0; l < LANES; l++)
#define FMA __builtin_fma

typedef double lanes[LANES];

typedef struct {
    double gravity;
    double d2x, d2y, d3x, d3y;         /* from joint to next joint, in the link's frame */
    double u2x, u2y, u3x, u3y, u4x, u4y; /* first moments, the mass beyond included */
    double k2, k3, k4;                 /* second moments, the mass beyond included */
} Arm;

/* The coefficients are those of fdof_jax/base/trigonometry.py. FMA keeps -ffast-math from
   merging the parts of pi/2. Good for angles up to some thousand turns. */
static inline void sincos1(double x, double *sine, double *cosine)
{
    double n = __builtin_rint(x * 0.63661977236758134308);
    double r = FMA(-n, 1.5707963267341256, x);
    r = FMA(-n, 6.077100506303966e-11, r);
    r = FMA(-n, 2.0222662487111665e-21, r);
    double z = r * r;
    double s = FMA(1.5918129027234826e-10, z, -2.505113184128889e-08);
    s = FMA(s, z, 2.7557316102534617e-06);
    s = FMA(s, z, -0.0001984126983675854);
    s = FMA(s, z, 0.008333333333330948);
    s = FMA(s, z, -0.16666666666666666);
    s = FMA(r * z, s, r);
    double c = FMA(-1.1382632258093615e-11, z, 2.087614626607931e-09);
    c = FMA(c, z, -2.7557317271718644e-07);
    c = FMA(c, z, 2.4801587298765665e-05);
    c = FMA(c, z, -0.0013888888888887398);
    c = FMA(c, z, 0.041666666666666664);
    c = FMA(z * z, c, FMA(-0.5, z, 1.0));
    long quadrant = (long)n;
    double a = quadrant & 1 ? c : s;
    double b = quadrant & 1 ? s : c;
    *sine = quadrant & 2 ? -a : a;
    *cosine = (quadrant + 1) & 2 ? -b : b;
}

/* y: three absolute angles, three rates. */
static inline __attribute__((always_inline)) void
rates(const Arm *p, lanes *restrict y, lanes *restrict k)
{
    FOR_LANES {
        double s2, c2, s3, c3, s4, c4;
        sincos1(y[0][l], &s2, &c2);
        sincos1(y[1][l], &s3, &c3);
        sincos1(y[2][l], &s4, &c4);
        double w2 = y[3][l], w3 = y[4][l], w4 = y[5][l];
        double d2x = p->d2x * c2 - p->d2y * s2, d2y = p->d2x * s2 + p->d2y * c2;
        double d3x = p->d3x * c3 - p->d3y * s3, d3y = p->d3x * s3 + p->d3y * c3;
        double u3x = p->u3x * c3 - p->u3y * s3, u3y = p->u3x * s3 + p->u3y * c3;
        double u4x = p->u4x * c4 - p->u4y * s4, u4y = p->u4x * s4 + p->u4y * c4;
        double u2x = p->u2x * c2 - p->u2y * s2;
        double m23 = d2x * u3x + d2y * u3y, x23 = d2x * u3y - d2y * u3x;
        double m24 = d2x * u4x + d2y * u4y, x24 = d2x * u4y - d2y * u4x;
        double m34 = d3x * u4x + d3y * u4y, x34 = d3x * u4y - d3y * u4x;
        double w22 = w2 * w2, w33 = w3 * w3, w44 = w4 * w4;
        double f2 = w33 * x23 + w44 * x24 - p->gravity * u2x;
        double f3 = w44 * x34 - w22 * x23 - p->gravity * u3x;
        double f4 = -w22 * x24 - w33 * x34 - p->gravity * u4x;
        /* Elimination from the tip. */
        double i4 = 1 / p->k4;
        double l34 = m34 * i4, l24 = m24 * i4;
        double i3 = 1 / (p->k3 - l34 * m34);
        double n23 = m23 - l24 * m34, l23 = n23 * i3;
        double g3 = f3 - l34 * f4;
        double a2 = (f2 - l24 * f4 - l23 * g3) / (p->k2 - l24 * m24 - l23 * n23);
        double a3 = g3 * i3 - l23 * a2;
        k[0][l] = w2;
        k[1][l] = w3;
        k[2][l] = w4;
        k[3][l] = a2;
        k[4][l] = a3;
        k[5][l] = f4 * i4 - l24 * a2 - l34 * a3;
    }
}

static void step(const Arm *p, double h, lanes *restrict y)
{
    lanes k[STAGES][6], next[6];
    rates(p, y, k[0]);
#pragma GCC unroll 16
    for (int i = 1; i < STAGES; i++) {
#pragma GCC unroll 6
        for (int v = 0; v < 6; v++) {
            lanes sum;
            FOR_LANES sum[l] = A[i][0] * k[0][v][l];
#pragma GCC unroll 16
            for (int j = 1; j < i; j++)
                if (A[i][j] != 0)
                    FOR_LANES sum[l] += A[i][j] * k[j][v][l];
            FOR_LANES next[v][l] = y[v][l] + h * sum[l];
        }
        rates(p, next, k[i]);
    }
#pragma GCC unroll 6
    for (int v = 0; v < 6; v++) {
        lanes sum;
        FOR_LANES sum[l] = B[0] * k[0][v][l];
#pragma GCC unroll 16
        for (int j = 1; j < STAGES; j++)
            if (B[j] != 0)
                FOR_LANES sum[l] += B[j] * k[j][v][l];
        FOR_LANES y[v][l] += h * sum[l];
    }
}

/* state: (blocks, 6, LANES), in and out; saved: (blocks, saves, 6, LANES). */
void integrate(const Arm *p, double h, long steps, long saves, long blocks,
               double *state, double *saved)
{
    for (long b = 0; b < blocks; b++) {
        lanes y[6];
        for (int v = 0; v < 6; v++)
            FOR_LANES y[v][l] = state[(b * 6 + v) * LANES + l];
        for (long s = 0; s < saves; s++) {
            for (long n = 0; n < steps; n++)
                step(p, h, y);
            for (int v = 0; v < 6; v++)
                FOR_LANES saved[((b * saves + s) * 6 + v) * LANES + l] = y[v][l];
        }
        for (int v = 0; v < 6; v++)
            FOR_LANES state[(b * 6 + v) * LANES + l] = y[v][l];
    }
}
