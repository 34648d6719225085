/**
 * Ambient occlusion that a server traces, as points that your shaders blend: the client.
 *
 * <pre>
 * PsaoBuffer input = new PsaoBuffer(65536);
 * PsaoConfig config = PsaoConfig.fromStream(input);      // or set the counts: your budget
 * try (PsaoClient client = new PsaoClient(config)) {
 *     // one thread: whoever has the bytes
 *     while (input.bytes().hasRemaining()) client.push(input, System.nanoTime());
 *     // the same thread or, with config.twoThreads, another: whoever draws
 *     PsaoFrame frame = client.take();
 *     if (frame != null) {
 *         int count = frame.dirtyRanges(PsaoFrame.CELLS, 16);
 *         for (int i = 0; i &lt; count; i++)
 *             upload(frame.rangeOffsetBytes(i), frame.range(i));
 *         client.release();
 *     }
 * }
 * </pre>
 *
 * <p>It is {@code psao.h} in Java: the same words, the same rules for threads and the same results
 * ({@link org.psao.PsaoResult}). No Android class is used, so that it runs on any Java from 8 on;
 * {@code org.psao.android} adds what only Android has. The native library is {@code psao_jni}.
 *
 * <p>Nothing here makes garbage once it is made, but exceptions, and the methods that say so.
 * Lengths and counts are in elements unless their names end in {@code Bytes}; times are
 * nanoseconds; distances are metres.
 */
package org.psao;
