"""The names of IsaacGymEnvs' and ASE's learning packages, and which of them are here.

Facts: lists of names, read off the published sources; nothing of their text. `name()` is a method,
`name(argument)` a method with this argument.
"""

from __future__ import annotations

# Our class -> published names that it has, too.
SAME: dict[str, str] = {
    "common_agent.CommonAgent": """
        init_tensors() train() save() train_epoch() play_steps() prepare_dataset()
        calc_gradients() discount_values() bound_loss() set_full_state_weights() env_reset()
        _load_config_params() _build_net_config() _setup_action_space() _init_train()
        _env_reset_done() _eval_critic() _actor_loss() _critic_loss() _calc_advs()
        _record_train_batch_info() _log_train_info() is_discrete bounds_loss_coef clip_actions
        model states last_lr optimizer dataset actions_num actions_low actions_high network_path
        train_result obs dones frame curr_frames epoch_num last_mean_rewards
    """,
    "amp_continuous.AMPAgent": """
        init_tensors() set_eval() set_train() get_stats_weights() set_stats_weights()
        play_steps() get_action_values() prepare_dataset() train_epoch() calc_gradients()
        _load_config_params() _build_net_config() _init_train() _disc_loss() _disc_loss_neg()
        _disc_loss_pos() _compute_disc_acc() _fetch_amp_obs_demo() _build_amp_buffers()
        _build_rand_action_probs() _init_amp_demo_buf() _update_amp_demos() _preproc_amp_obs()
        _combine_rewards() _eval_disc() _calc_advs() _calc_amp_rewards() _calc_disc_rewards()
        _store_replay_amp_obs() _record_train_batch_info() _log_train_info()
        _normalize_amp_input _amp_input_mean_std _task_reward_w _disc_reward_w
        _amp_observation_space _amp_batch_size _amp_minibatch_size _disc_coef _disc_logit_reg
        _disc_grad_penalty _disc_weight_decay _disc_reward_scale _amp_obs_demo_buffer
        _amp_replay_buffer _amp_replay_keep_prob _enable_eps_greedy _rand_action_probs
    """,
    "gen_amp.GenAMPAgent": """
        init_tensors() play_steps() get_action_values() prepare_dataset() calc_gradients()
        env_reset() _load_config_params() _build_net_config() _sample_latents()
        _update_latents() _eval_actor() _eval_critic() _calc_amp_rewards() _calc_enc_rewards()
        _diversity_loss() _enable_enc_grad_penalty() _enable_amp_diversity_bonus() _eval_enc()
        _combine_rewards() _record_train_batch_info() _log_train_info() _latent_dim
        _latent_steps_min _latent_steps_max _amp_diversity_bonus _amp_diversity_tar _enc_coef
        _enc_weight_decay _enc_reward_scale _enc_grad_penalty _enc_reward_w _ase_latents
        _latent_reset_steps
    """,
    "hrl_continuous.HRLAgent": """
        init_tensors() env_step() cast_obs() preprocess_actions() play_steps()
        _load_config_params() _setup_action_space() _build_llc() _build_llc_agent_config()
        _compute_llc_action() _extract_llc_obs() _calc_disc_reward() _combine_rewards()
        _record_train_batch_info() _log_train_info() _latent_dim _task_size _llc_steps
        _llc_agent _task_reward_w _disc_reward_w
    """,
    "common_player.CommonPlayer": """
        run() obs_to_torch() get_action() _build_net() _build_net_config() _post_step()
        _setup_action_space() network normalize_input normalize_value model is_rnn actions_num
        actions_low actions_high
    """,
    "amp_players.AMPPlayerContinuous": """
        restore() _build_net() _post_step() _build_net_config() _amp_debug() _preproc_amp_obs()
        _eval_disc() _calc_amp_rewards() _calc_disc_rewards() _normalize_amp_input
        _disc_reward_scale _print_disc_prediction _amp_input_mean_std
    """,
    "gen_amp_players.GenAMPPlayerContinuous": """
        run() get_action() _build_net_config() _calc_amp_rewards() _calc_enc_rewards()
        _eval_enc() _amp_debug() _latent_dim _latent_steps_min _latent_steps_max
        _enc_reward_scale _ase_latents
    """,
    "hrl_players.HRLPlayer": """
        run() get_action() _setup_action_space() _build_llc() _build_llc_agent_config()
        _compute_llc_action() _extract_llc_obs() _latent_dim _task_size _llc_steps _llc_agent
    """,
    "amp_datasets.AMPDataset": """
        update_mu_sigma() _get_item() _shuffle_idx_buf() _idx_buf
    """,
    "replay_buffer.ReplayBuffer": """
        reset() get_buffer_size() get_total_count() store() sample() _reset_sample_idx()
        _init_data_buf() _head _total_count _buffer_size _device _data_buf _sample_idx
        _sample_head
    """,
    "amp_models.ModelAMPContinuous": "build() Network.forward()",
    "gen_amp_models.ModelGenAMPContinuous": "build() Network.forward()",
    "hrl_models.ModelHRLContinuous": "build() Network",
    "amp_network_builder.AMPBuilder": "build()",
    "amp_network_builder.AMPBuilder.Network": """
        load() forward() eval_actor() eval_critic() eval_disc() get_disc_logit_weights()
        get_disc_weights() _build_disc() _disc_units _disc_activation _disc_initializer
        _disc_mlp _disc_logits sigma
    """,
    "gen_amp_network_builder.GenAMPBuilder": "build()",
    "gen_amp_network_builder.GenAMPBuilder.Network": """
        load() forward() eval_actor() eval_critic() eval_enc() get_enc_weights()
        sample_latents() _build_enc() _ase_latent_shape _enc_units _enc_activation
        _enc_initializer _enc_separate _enc_mlp _enc
    """,
    "gen_amp_network_builder.StyleMLP": """
        forward() eval_style() _activation _style_mlp _style_dense _dense_layers
    """,
    "gen_amp_network_builder.LatentMLP": "forward() _mlp",
    "hrl_network_builder.HRLBuilder": "build()",
    "hrl_network_builder.HRLBuilder.Network": "forward() eval_critic()",
}

# Our class -> published names that it lacks, of networks only methods.
MISSING: dict[str, str] = {
    "common_agent.CommonAgent": """
        central_value_net use_experimental_cv env_reset(env_ids) running_mean_std
        _get_mean_rewards() model_output_file _save_intermediate
    """,
    "amp_continuous.AMPAgent": """
        get_action_values(rand_action_probs) _amp_debug()
    """,
    "gen_amp.GenAMPAgent": """
        get_action_values(ase_latents) _eval_critic(ase_latents) _reset_latents()
        _reset_latent_step_count() _enc_loss() _calc_enc_error() _change_char_color()
        _amp_debug()
    """,
    "hrl_continuous.HRLAgent": """
        _build_llc(config_params) _build_llc_agent_config(config_params) _get_mean_rewards()
    """,
    "common_player.CommonPlayer": """
        running_mean_std _env_reset_done() env_step() env_reset() mask
    """,
    "gen_amp_players.GenAMPPlayerContinuous": """
        _reset_latents() _update_latents() _reset_latent_step_count() _calc_enc_error()
        env_reset() _change_char_color() _latent_step_count
    """,
    "hrl_players.HRLPlayer": """
        _build_llc(config_params) _build_llc_agent_config(config_params) env_step()
        _calc_disc_reward()
    """,
    "gen_amp_network_builder.GenAMPBuilder.Network": """
        _build_actor_critic_net()
    """,
    "gen_amp_network_builder.StyleMLP": """
        init_params() get_out_size() _build_style_mlp()
    """,
    "gen_amp_network_builder.LatentMLP": """
        init_params() get_out_size()
    """,
}
