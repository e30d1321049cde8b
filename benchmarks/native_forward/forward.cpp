// Composite the block lists of a view with AVX-512, 16 pixels a register: the work of
// `mgs.splat.kernels.forward`, whose state of a block's pixels does not fit into registers, in
// native code, where it does. Usage: forward FOLDER THREADS ROUNDS; prints the milliseconds of each
// round, and writes FOLDER/native.bin, [lanes][r,g,b,alpha,depth][32] float32.
#include <immintrin.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

template <class T> std::vector<T> read(const std::string &path) {
    FILE *file = fopen(path.c_str(), "rb");
    fseek(file, 0, SEEK_END);
    size_t bytes = ftell(file);
    rewind(file);
    std::vector<T> values(bytes / sizeof(T));
    if (fread(values.data(), 1, bytes, file) != bytes) abort();
    fclose(file);
    return values;
}

// 2^x to 8e-8, by the polynomial of mgs.splat.walking.EXP2.
static inline __m512 exp2_(__m512 x) {
    const float c[] = {0.00015345812f, 0.00133999314f, 0.00961848896f, 0.05550328776f,
                       0.24022646891f, 0.69314720574f, 1.0f};
    __m512 n = _mm512_roundscale_ps(x, 0), f = _mm512_sub_ps(x, n), v = _mm512_set1_ps(c[0]);
    for (int i = 1; i < 7; i++) v = _mm512_fmadd_ps(v, f, _mm512_set1_ps(c[i]));
    return _mm512_scalef_ps(v, n);
}

int main(int, char **argv) {
    const std::string folder = std::string(argv[1]) + "/";
    const int threads = atoi(argv[2]), rounds = atoi(argv[3]);
    auto size = read<int>(folder + "size.bin");
    auto block = read<int>(folder + "block.bin"), start = read<int>(folder + "start.bin");
    auto end = read<int>(folder + "end.bin"), splat = read<int>(folder + "splat.bin");
    auto packed = read<float>(folder + "packed.bin");
    const int across = (size[0] + 7) / 8, lanes = block.size();
    std::vector<float> out(lanes * 160);
    const __m512 zero = _mm512_setzero_ps(), sign = _mm512_set1_ps(-0.f);
    const __m512 least = _mm512_set1_ps(1 / 255.f), most = _mm512_set1_ps(0.99f);
    const __m512 stop = _mm512_set1_ps(1e-4f);
    const __m512 i8 = _mm512_setr_ps(0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7);
    const __m512 j2 = _mm512_setr_ps(0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1);

    auto draw = [&](int lane) {
        float x = block[lane] % across * 8 + .5f, y = block[lane] / across * 4 + .5f;
        __m512 X = _mm512_add_ps(i8, _mm512_set1_ps(x)), Y[2], T[2], sum[5][2];
        for (int h = 0; h < 2; h++) {
            Y[h] = _mm512_add_ps(j2, _mm512_set1_ps(y + 2 * h));
            T[h] = _mm512_set1_ps(1);
            for (auto &s : sum) s[h] = zero;
        }
        for (int i = start[lane]; i < end[lane]; i++) {
            const float *s = &packed[16 * (size_t)splat[i]];
            if (i + 8 < end[lane])
                _mm_prefetch((const char *)&packed[16 * (size_t)splat[i + 8]], _MM_HINT_T0);
            __m512 dx = _mm512_sub_ps(X, _mm512_set1_ps(s[0]));
            const float numbers[] = {s[8], s[9], s[10], 1, s[12]};
            for (int h = 0; h < 2; h++) {
                __m512 dy = _mm512_sub_ps(Y[h], _mm512_set1_ps(s[1]));
                __m512 xi = _mm512_fnmadd_ps(_mm512_set1_ps(s[2]), dy, dx);
                xi = _mm512_mul_ps(_mm512_set1_ps(s[3]), xi);
                __m512 eta = _mm512_mul_ps(_mm512_set1_ps(s[4]), dy);
                __m512 power = _mm512_fnmadd_ps(xi, xi, _mm512_set1_ps(s[5]));
                __m512 alpha = exp2_(_mm512_fnmadd_ps(eta, eta, power));
                __mmask16 drawn = _mm512_cmp_ps_mask(alpha, least, _CMP_GE_OQ);
                alpha = _mm512_maskz_min_ps(drawn, alpha, most);
                __m512 after = _mm512_fnmadd_ps(alpha, T[h], T[h]);
                __mmask16 room = _mm512_cmp_ps_mask(after, stop, _CMP_GT_OQ);
                __m512 w = _mm512_maskz_mul_ps(room, alpha, T[h]);
                T[h] = _mm512_mask_mov_ps(_mm512_or_ps(T[h], sign), room, after);
                for (int c = 0; c < 5; c++)
                    sum[c][h] = _mm512_fmadd_ps(w, _mm512_set1_ps(numbers[c]), sum[c][h]);
            }
            if ((i & 3) == 3 && !(_mm512_cmp_ps_mask(T[0], zero, _CMP_GT_OQ) |
                                  _mm512_cmp_ps_mask(T[1], zero, _CMP_GT_OQ)))
                break;
        }
        for (int c = 0; c < 5; c++)
            for (int h = 0; h < 2; h++)
                _mm512_storeu_ps(&out[lane * 160 + 32 * c + 16 * h], sum[c][h]);
    };

    for (int round = 0; round < rounds; round++) {
        auto began = std::chrono::steady_clock::now();
        std::atomic<int> next{0};
        auto work = [&] {
            for (int first; (first = next.fetch_add(64)) < lanes;)
                for (int lane = first; lane < std::min(first + 64, lanes); lane++) draw(lane);
        };
        std::vector<std::thread> others;
        for (int i = 1; i < threads; i++) others.emplace_back(work);
        work();
        for (auto &other : others) other.join();
        std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - began;
        printf("%.4f\n", took.count());
    }
    FILE *file = fopen((folder + "native.bin").c_str(), "wb");
    fwrite(out.data(), 4, out.size(), file);
    fclose(file);
}
